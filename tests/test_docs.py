"""The documentation builds without a warning, asks nothing of a network, and is complete."""

import dataclasses
import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import jaxid
from jaxid.control import Reading, Reference

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The pages, built as strictly as mkdocs can."""
    for module in ("mkdocs", "material", "mkdocstrings", "latex2mathml"):
        pytest.importorskip(module, reason="the extra `docs` is not installed")
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(out)]
    # The theme's own news are no warning of ours.
    quiet = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    built = subprocess.run(
        command, cwd=ROOT, env=quiet, capture_output=True, text=True, check=False
    )
    assert built.returncode == 0, built.stderr
    assert "WARNING" not in built.stderr
    return out


class Loaded(HTMLParser):
    """What a page has the browser fetch."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        fetched = {"link": "href", "script": "src", "img": "src", "iframe": "src"}
        # A page's own address among search engines is a link that nothing fetches.
        if tag in fetched and given.get("rel") != "canonical":
            self.addresses += [a for a in [given.get(fetched[tag])] if a]


def test_it_builds_and_fetches_nothing_from_elsewhere(site: Path) -> None:
    pages = sorted(site.rglob("*.html"))
    assert len(pages) > 15
    for page in pages:
        for address in Loaded(page.read_text(encoding="utf-8")).addresses:
            assert not re.match(r"(https?:)?//", address), f"{page.name} fetches {address}"
            local = (page.parent / address.split("#")[0].split("?")[0]).resolve()
            # The page that stands for missing ones has addresses from the site's root.
            assert local.exists() or page.name == "404.html", f"{page.name} lacks {address}"


def test_equations_are_drawn_without_a_script(site: Path) -> None:
    text = (site / "method.html").read_text(encoding="utf-8")
    assert text.count("<math") > 15
    assert "arithmatex" not in re.sub(r"<style.*?</style>", "", text, flags=re.DOTALL)
    assert "\\" not in "".join(re.findall(r"<math.*?</math>", text, flags=re.DOTALL))


def test_the_api_shows_what_daily_names_do(site: Path) -> None:
    pages = "".join(p.read_text(encoding="utf-8") for p in (site / "api").glob("*.html"))
    shown = set(re.findall(r'id="(jaxid[\w.]+)"', pages))
    last = {name.rpartition(".")[2] for name in shown}
    for name in ("read", "fit", "OEM", "compare", "diagnose", "discover", "ClosedLoop", "Curve"):
        assert name in last
    assert "jaxid.discover" in shown


def test_every_effect_of_the_catalogue_is_described_and_drawn() -> None:
    text = (DOCS / "catalogue.md").read_text(encoding="utf-8")
    for effect in jaxid.catalogue:
        name = effect.__name__
        assert f"(`{name}`)" in text
        assert f"(img/effects/{name}.png)" in text
        assert (DOCS / "img" / "effects" / f"{name}.png").stat().st_size > 5000


@pytest.mark.parametrize("effect", jaxid.catalogue, ids=lambda e: e.__name__)
def test_tables_of_the_catalogue_have_the_declared_parameters(effect: type) -> None:
    """Symbol, unit, bounds and kind of each, beside those with several values."""
    text = (DOCS / "catalogue.md").read_text(encoding="utf-8")
    (section,) = re.findall(
        rf"^## \w+ \(`{effect.__name__}`\)\n(.*?)(?=^## |\Z)", text, re.M | re.S
    )
    rows = re.findall(r"^\| (.+?) \| `(\w+)` \| (.+?) \| (.*?) \| (\w+)", section, re.M)
    found = {
        field: (symbol, unit, bounds.strip(), kind) for symbol, field, unit, bounds, kind in rows
    }
    found.pop("rest", None)
    declared = {}
    for field in dataclasses.fields(effect):
        p = field.metadata.get("parameter")
        if p is None or field.name == "rest":
            continue
        low, high = (
            f"{x / np.pi:g}π" if abs(x) == 2 * np.pi else f"{x:.6g}" for x in (p.lower, p.upper)
        )
        bounds = f"{low} to {high}" if np.isfinite(p.upper) else f"≥ {low}"
        kind = "held" if not p.free else "amplitude" if p.linear else "shape"
        bounds = bounds if np.isfinite(p.lower) else ""
        declared[field.name] = p.symbol.rstrip("_"), p.unit, bounds, kind
    assert found == declared


def test_pictures_of_look_alikes_are_there() -> None:
    text = (DOCS / "look-alikes.md").read_text(encoding="utf-8")
    named = set(re.findall(r"\]\(img/alike/(\w+\.png)\)", text))
    drawn = {path.name for path in (DOCS / "img" / "alike").glob("*.png")}
    assert named == drawn
    assert len(drawn) > 5


def test_pictures_named_in_the_readme_are_there_and_small() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    named = re.findall(r"\]\((docs/[^)#]+)", text)
    assert any(path.endswith(".png") for path in named)
    for path in named:
        assert (ROOT / path).is_file(), path
        assert (ROOT / path).stat().st_size < 400_000


def in_a_row(*names: str) -> str:
    """A URDF of links in a row, one joint each."""
    body = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1"/></inertial>'
    links = [f'<link name="{name}">{body}</link>' for name in names]
    ends = list(zip(("base", *names), names, strict=False))
    joints = [
        f'<joint name="to_{child}" type="continuous"><origin xyz="0.3 0 0"/><axis xyz="0 1 0"/>'
        f'<parent link="{parent}"/><child link="{child}"/></joint>'
        for parent, child in ends
    ]
    return f'<robot name="arm"><link name="base"/>{"".join(links + joints)}</robot>'


def test_code_of_bring_your_own_runs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    Path("arm.urdf").write_text(
        in_a_row("shoulder", "upper", "fore", "wrist_1", "wrist_2", "wrist_3_link"),
        encoding="utf-8",
    )
    asked: list[Any] = []
    monkeypatch.setattr(jaxid, "read", lambda *files, **given: asked.append(given))
    monkeypatch.setattr(jaxid, "fit", lambda loop, _: SimpleNamespace(loop=loop))
    monkeypatch.setattr(jaxid, "discover", lambda *args, **given: asked.append(given))
    text = (DOCS / "your-own.md").read_text(encoding="utf-8")
    own: dict[str, Any] = {"jaxid": jaxid, "recordings": None}
    for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
        exec(block, own)
    assert set(asked[0]["columns"]) == {"time", "q", "tau"}
    assert [a["catalogue"][-1] for a in asked if "catalogue" in a] == [own["Hose"]]
    # Stretched out level, three masses of 1 kg hang on the first joint at 0.4, 0.7 and 0.9 m.
    q, none = jnp.array([jnp.pi / 2, 0.0, 0.0]), jnp.zeros(3)
    held = own["ThreeLinks"]().bias(q, none)
    np.testing.assert_allclose(held, [9.81 * 2.0, 9.81 * 0.8, 9.81 * 0.2], rtol=1e-12)
    law = own["PID"](Kp=jnp.ones(3), Ki=2 * jnp.ones(3), Kd=jnp.ones(3))
    reading, reference = Reading(none, none), Reference(q, none, none, none)
    state = law.initial_state(reading) + law.derivative(reading, reference, none)
    np.testing.assert_allclose(law.command(reading, reference, state, jnp.eye(3)), 3 * q)


def blocks(page: str) -> list[str]:
    """The Python code of a page, block by block."""
    text = (DOCS / page).read_text(encoding="utf-8")
    return re.findall(r"```python\n(.*?)```", text, re.DOTALL)


def moved(joints: int) -> jaxid.Recording:
    """A reference that starts at rest and moves by a tenth of a radian in a second."""
    time = np.arange(0.0, 1.0, 0.002)
    q_ref = 0.1 * np.stack([np.sin(1.5 * time) ** 2] * joints, axis=1)
    return jaxid.Recording(time, q_ref, np.zeros_like(q_ref), q_ref=q_ref)


def test_every_law_of_the_docs_follows_its_reference(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("arm.urdf").write_text(in_a_row("upper", "fore", "wrist"), encoding="utf-8")
    own: dict[str, Any] = {}
    loops: list[jaxid.ClosedLoop] = []
    for block in blocks("laws.md"):
        exec(block, own)
        found = [v for v in own.values() if isinstance(v, jaxid.ClosedLoop)]
        loops += [loop for loop in found if not any(loop is had for had in loops)]
    laws = [type(loop.controller).__name__ for loop in loops]
    assert laws == ["PD", "PID", "PositionVelocity", "ComputedTorque", "Sampled", "PD"]
    servo = jaxid.ClosedLoop(jaxid.arms.Axis(M=0.01), own["servo"], [jaxid.effects.Viscous(1, 0.3)])
    for loop in (*loops, servo):
        run = jaxid.simulate(loop, moved(loop.joints))[0]
        # The PD law lags by Kv/Kp = 0.2 s, at 0.15 rad/s; without control the error is 0.1 rad.
        away = np.abs(np.asarray(run.q) - moved(loop.joints).q_ref).max()
        assert away < 0.05, loop.controller


def test_the_cascade_of_the_docs_is_a_pi_law_in_closed_form() -> None:
    own: dict[str, Any] = {}
    for block in blocks("laws.md")[:3]:
        exec(block, own)
    law = own["PositionVelocity"]()
    reading = Reading(jnp.array([0.1]), jnp.array([0.2]))
    reference = Reference(*(jnp.array([x]) for x in (0.3, 0.4, 0.0, 0.5)))
    error = 20.0 * 0.2 + 0.4 - 0.2
    np.testing.assert_allclose(law.derivative(reading, reference, jnp.zeros(1)), [error])
    held = law.command(reading, reference, jnp.array([0.01]), jnp.eye(1))
    np.testing.assert_allclose(held, [8.0 * error + 40.0 * 0.01 + 0.5])


def test_code_of_the_page_on_servos_runs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    t = np.arange(0, 1, 0.005)
    goal = 0.5 * np.sin(4 * t)
    table = np.column_stack([t, goal, 0.9 * goal, 885 * 0.1 * goal, t < 0.8])
    for kp in (100, 800):
        header = "t,q_goal,q,pwm,torque_on"
        np.savetxt(f"kp{kp}.csv", table, delimiter=",", header=header, comments="")
    asked: list[Any] = []
    monkeypatch.setattr(jaxid, "fit", lambda loop, runs: SimpleNamespace(loop=loop))
    monkeypatch.setattr(jaxid, "discover", lambda *args, **given: asked.append(args))
    monkeypatch.setattr(jaxid, "simulator_terms", lambda fit: asked.append(fit.loop))
    text = (DOCS / "servos.md").read_text(encoding="utf-8")
    own: dict[str, Any] = {}
    for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
        exec(block, own)
    _, runs = asked[0]
    assert [r.kp[0, 0] for r in runs] == [100, 800]
    np.testing.assert_allclose(runs[0].tau[:, 0], 0.1 * 7.4 * goal, rtol=1e-3, atol=1e-12)
    assert runs[1].on.sum() == 160
    # Held at the horizontal, an open motor gives nothing, and a powered one its stall torque.
    run = jaxid.simulate(own["loop"], runs[1])[0]
    assert np.all(run.delivered[t >= 0.8] == 0)
    assert np.abs(run.delivered[t < 0.8]).max() > 0.01
