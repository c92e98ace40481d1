"""Pictures of each effect, and of the residual of a fit without it: docs/img/effects.

PYTHONPATH=. python docs/pictures.py [Stribeck ...]    needs the extra `static`; a minute for all
"""

import sys
from pathlib import Path

import numpy as np
import plotly.graph_objects as go
from jaxtyping import Float
from plotly.subplots import make_subplots

import jaxid
from jaxid.chain import Chain
from jaxid.discovery.diagnosis import Verdict, coordinate_unit
from jaxid.display import figures
from jaxid.effects import BaseTilt, CableDrag, CarriedBody, Counterbalance, Curve, SharedShaft

OUT = Path(__file__).parent / "img" / "effects"
DEMO = Path(jaxid.__file__).parent / "demo" / "clean"
COORDINATES = ("q", "v", "a", "tau")
# The arm of the demo as a chain in space: two vertical axes, and the inertial parameters.
CHAIN = Chain(
    np.tile(np.eye(3), (2, 1, 1)),
    ((0.0, 0.0, 0.0), (0.5, 0.0, 0.0)),
    ((0.0, 0.0, 1.0),) * 2,
    (0.0, 0.0, -9.81),
    (False, False),
    (0.4, 0.0, 0.0),
)
LINKS = ((0.0,) * 6 + (1.0, 0.0, 0.0, 4.0), (0.0,) * 6 + (0.3, 0.0, 0.0, 1.5))
# Effects that are not proposed for a planar arm, with settings that show them well.
ELSEWHERE = (
    Counterbalance(joint=2, angle=-1.0),
    SharedShaft(joint=1, driven=2),
    CableDrag(joint=1, following=2),
    BaseTilt(CHAIN, LINKS),
    CarriedBody(CHAIN, recordings=("fit_2",)),
)


def main() -> None:
    """Writes one picture for each class of the catalogue, or for each class that is named."""
    recordings = jaxid.read(DEMO / "fit_1.csv", DEMO / "fit_2.csv")
    wanted = [e for e in jaxid.catalogue if e.__name__ in (sys.argv[1:] or [e.__name__])]
    catalogue = (*wanted, *(e for e in ELSEWHERE if type(e) in wanted))
    fit = jaxid.fit(jaxid.scara(), recordings)
    diagnosis = jaxid.diagnose(fit, catalogue=catalogue, progress=False)
    OUT.mkdir(parents=True, exist_ok=True)
    for effect in wanted:
        forms = [v for v in diagnosis.forms if type(v.hypothesis.effect) is effect]
        # Effects show most on the lighter joint; some effects have no joint or act on both.
        shown = next((v for v in forms if v.hypothesis.joint == 2), forms[0])
        path = OUT / f"{effect.__name__}.png"
        draw(diagnosis, shown).write_image(path, width=900, height=230, scale=1)
        print(path.name, path.stat().st_size)


def waves(
    diagnosis: jaxid.Diagnosis, verdict: Verdict
) -> tuple[Float[np.ndarray, "recordings samples 2"], Float[np.ndarray, "recordings samples 2"]]:
    """The torque of the effect, and its part in the residual of a fit without the effect.

    The fitted parameters absorb as much of the torque as they can; the rest is the residual.
    """
    data, columns = diagnosis.data, list(verdict.hypothesis.columns)
    # Only the first amplitude: a sine and a cosine look alike.
    wave = data.table[..., columns[0]]
    size = np.sqrt(np.mean(wave**2, axis=(0, 1))).max()
    weights = 1 / np.sqrt(np.mean(data.residual**2, axis=(0, 1)))
    base = data.base * weights[:, None]
    flat = base.reshape(-1, base.shape[-1])
    bent = np.linalg.lstsq(flat, (wave * weights).ravel(), rcond=None)[0]
    return wave / size, (wave - data.base @ bent) / size


def telling(diagnosis: jaxid.Diagnosis, wave: np.ndarray, joint: int) -> tuple[Curve, np.ndarray]:
    """The coordinate on which the torque depends most, with or without the sign of velocity."""
    motion, mask = diagnosis.motion, diagnosis.data.mask
    y = wave[..., joint - 1][mask]
    sign = np.sign(np.asarray(motion.v)[..., joint - 1][mask])
    best, found, along = -1.0, Curve(joint=joint, coordinate="q", of=joint), y
    for kind in COORDINATES:
        values = np.asarray(getattr(motion, kind))
        x = values[..., joint - 1][mask]
        order = np.array_split(np.argsort(x, kind="stable"), 30)
        for signed in (False, True):
            z = y * sign if signed else y
            rest = sum(np.sum((z[k] - z[k].mean()) ** 2) for k in order)
            # The unsigned curve is preferred where both fit about equally well.
            share = 1 - rest / np.sum((z - z.mean()) ** 2) - 0.02 * signed
            if share > best:
                best, along = share, x
                found = Curve(joint=joint, coordinate=kind, of=joint, signed=signed)
    return found, along


def draw(diagnosis: jaxid.Diagnosis, verdict: Verdict) -> go.Figure:
    """The effect against its coordinate; the residual in time and against its coordinate."""
    whole, rest = waves(diagnosis, verdict)
    power = np.mean(rest**2, axis=(0, 1))
    joint = verdict.hypothesis.joint or int(power.argmax()) + 1
    recording = int(np.mean(rest[..., joint - 1] ** 2, axis=1).argmax())
    titles = ("torque of the effect", "residual of a fit without it", "the same residual")
    widths = [0.27, 0.44, 0.29]
    figure = make_subplots(
        1, 3, column_widths=widths, horizontal_spacing=0.075, subplot_titles=titles
    )
    mask = diagnosis.data.mask
    time, first = diagnosis.fit.recordings[recording].time, rest[recording, mask[recording]]
    line = {"color": figures.ORANGE, "width": 1.6}
    figure.add_scatter(x=time, y=first[:, joint - 1], mode="lines", line=line, row=1, col=2)
    figure.update_xaxes(title_text="time (s)", row=1, col=2)
    cloud(figure, diagnosis, whole, joint, column=1, colour=figures.BLUE)
    cloud(figure, diagnosis, rest, joint, column=3, colour=figures.ORANGE)
    figure.update_layout(template=figures.theme(), showlegend=False)
    figure.update_layout(margin={"l": 45, "r": 10, "t": 28, "b": 45})
    figure.update_annotations(font_size=12.5)
    figure.update_yaxes(showticklabels=False)
    return figure


def cloud(
    figure: go.Figure,
    diagnosis: jaxid.Diagnosis,
    wave: Float[np.ndarray, "recordings samples 2"],
    joint: int,
    column: int,
    colour: str,
) -> None:
    """A torque against the coordinate on which it depends most."""
    curve, x = telling(diagnosis, wave, joint)
    mask, motion = diagnosis.data.mask, diagnosis.motion
    y = wave[..., joint - 1][mask]
    if curve.signed:
        y = y * np.sign(np.asarray(motion.v)[..., joint - 1][mask])
    dots = {"color": colour, "size": 3, "opacity": 0.5}
    few = np.random.default_rng(0).permutation(len(x))[:600]
    figure.add_scatter(x=x[few], y=y[few], mode="markers", marker=dots, row=1, col=column)
    torque, position = diagnosis.fit.loop.arm.units()
    unit = coordinate_unit(curve, torque, position)
    figure.update_xaxes(title_text=f"{curve.spoken_coordinate} ({unit})", row=1, col=column)
    factor = " × sign of v" if curve.signed else ""
    figure.update_yaxes(title_text=f"torque {joint}{factor}", row=1, col=column)


if __name__ == "__main__":
    main()
