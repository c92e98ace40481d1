"""Saved results: the same when read back."""

import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import diffrax
import equinox as eqx
import jax
import numpy as np
import pandas as pd
import pytest
from test_discover_cli import told

import jaxid
from jaxid.chain import Chain
from jaxid.errors import SaveError
from jaxid.storage import archive, saved

# What one worker has fitted serves all of them.
pytestmark = pytest.mark.xdist_group("demo")

# Written by the first version that could write files; every later one must read it.
FIRST_FORMAT = Path(__file__).parent / "data" / "format_1.jaxid"


class Hose(jaxid.effects.AbstractEffect):
    """A user's own effect."""

    joint: int = eqx.field(static=True)
    pull: jax.Array = jaxid.parameter(0.0, symbol="hose", unit="N·m", scale=0.1)


def same(one: Any, other: Any) -> None:
    """Asserts that two trees are equal to the bit."""
    assert jax.tree.structure(one) == jax.tree.structure(other)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        if isinstance(a, pd.DataFrame):
            pd.testing.assert_frame_equal(a, b, check_exact=True)
        else:
            assert isinstance(b, type(a)) or type(b) is float
            assert np.asarray(a).dtype == np.asarray(b).dtype
            assert np.asarray(a).tobytes() == np.asarray(b).tobytes()


def again(value: Any, classes: tuple[type, ...] = ()) -> Any:
    """What is read of what is written."""
    return archive.unpack(archive.pack(value), "here", saved.registry(classes))


def test_a_story_comes_back_to_the_bit(tmp_path: Path) -> None:
    story = told().story
    story.save(tmp_path / "story.jaxid")
    back = jaxid.load(tmp_path / "story.jaxid")
    same(story.stored(), back)
    assert repr(back) == repr(story)
    assert back.to_dict() == story.to_dict()
    same(back.diagnosis.table(), story.diagnosis.table())
    # What explains which part of the residual is there without the signatures, in six digits.
    assert back.diagnosis.data.table.width == back.diagnosis.data.base.size == 0
    drawn, seen = (
        [np.asarray(trace.y, float) for trace in s.first_diagnosis.plot_shares(joint=2).data]
        for s in (back, story)
    )
    for y, expected in zip(drawn, seen, strict=True):
        np.testing.assert_allclose(y, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())
    # What was one object in several places is one again, and a second round changes nothing.
    second = archive.pack(back)
    assert len(second) <= (tmp_path / "story.jaxid").stat().st_size
    same_bytes = archive.pack(again(back)) == second
    assert same_bytes


def test_a_loaded_fit_works_as_before(tmp_path: Path) -> None:
    fit = told().story.fit
    fit.save(tmp_path / "fit.jaxid")
    back = jaxid.load(tmp_path / "fit.jaxid")
    pd.testing.assert_frame_equal(back.table(), fit.table(), check_exact=True)
    same(jaxid.simulate(back.loop, back.recordings), jaxid.simulate(fit.loop, fit.recordings))
    comparison = jaxid.compare(fit, fit.recordings)
    comparison.save(tmp_path / "comparison.jaxid")
    same(jaxid.compare(back, back.recordings), jaxid.load(tmp_path / "comparison.jaxid"))
    diagnosis = jaxid.diagnose(back, progress=False)
    diagnosis.save(tmp_path / "diagnosis.jaxid")
    same(told().story.diagnosis.table(), jaxid.load(tmp_path / "diagnosis.jaxid").table())


def test_a_loaded_story_writes_the_same_page(tmp_path: Path) -> None:
    story = told().story
    texts = [
        jaxid.write_report(s, tmp_path / f"{k}.html").read_text(encoding="utf-8")
        for k, s in enumerate((story, story.stored(), again(story.stored())))
    ]
    # Figures get a name drawn anew for each page, and digits of single precision in a file.
    lengths = [len(text) for text in texts]
    assert lengths[1] == lengths[2]
    said = [re.findall(r"<h[1-6][^>]*>.*?</h[1-6]>|<td[^>]*>.*?</td>", text) for text in texts]
    assert said[0] == said[1]


def test_an_array_that_is_there_often_is_written_once() -> None:
    one = np.arange(1000.0)
    pair = {"one": one, "other": one.copy()}
    assert len(archive.pack(pair)) < 1.5 * len(archive.pack({"one": one}))
    same(again(pair), pair)


def test_loops_of_every_class_come_back() -> None:
    own = ("Payload", "BaseTilt", "CarriedBody")
    scene_free = [e for e in jaxid.catalogue if e.__name__ not in own]
    # A joint has one transmission at the most.
    place = {"Backlash": 2}
    effects = [
        e(joint=place.get(e.__name__, 1)) if "joint" in _fields(e) else e() for e in scene_free
    ]
    controllers = (
        jaxid.control.PD(Kp=[1.0, 2.0], Kv=[3.0, 4.0]),
        jaxid.control.Sampled(jaxid.control.PD(Kp=[1.0, 2.0], Kv=[3.0, 4.0]), every=0.01),
        jaxid.control.Tracking(cutoff=12.5),
        jaxid.control.OpenLoop(),
    )
    loops = [jaxid.scara(c).add(*effects, jaxid.effects.Payload()) for c in controllers]
    chain = Chain(
        np.tile(np.eye(3), (2, 1, 1)), np.ones((2, 3)), np.eye(3)[:2], (0, 0, -9.81), (False,) * 2
    )
    carried = jaxid.effects.CarriedBody(chain, 0.5, (0.1, 0.2), ("a",), (6, 7))
    tilted = jaxid.effects.BaseTilt(chain, np.ones((2, 10)), x=0.1)
    loops += [loop.add(carried, tilted) for loop in loops[:1]]
    loops += [jaxid.two_link(), jaxid.two_link(link_length=0.3)]
    loops += [jaxid.emps(jaxid.control.Cascade(delay=True)).hold("M").free("eps1")]
    loops += [dataclasses.replace(jaxid.emps(), resolution=(1e-6,))]
    for loop in loops:
        same(loop, again(loop))


def _fields(cls: type) -> set[str]:
    return {field.name for field in dataclasses.fields(cls)}


def test_steps_of_diffrax_come_back() -> None:
    stepping = jaxid.Stepping(
        solver=diffrax.Kvaerno3(), control=diffrax.PIDController(rtol=1e-6, atol=1e-9)
    )
    loop = dataclasses.replace(jaxid.scara(), stepping=stepping)
    same(loop, again(loop))


def test_methods_come_back(small_fit: jaxid.Fit) -> None:
    pem = jaxid.SeparablePEM(
        jaxid.OEM(window=0.5), filters=(jaxid.noise.ARFilter(np.ones(2), 3.0),)
    )
    methods = (jaxid.OEM(), pem, jaxid.IDIMIV(), jaxid.DIDIM())
    for method in methods:
        back = again(dataclasses.replace(small_fit, method=method))
        assert repr(back.method) == repr(method)
        same(method, back.method)


def test_numbers_that_are_not_finite_come_back(small_fit: jaxid.Fit) -> None:
    covariance = np.full_like(small_fit.covariance, np.inf)
    covariance[0, 0], covariance[1, 1] = np.nan, -np.inf
    odd = dataclasses.replace(small_fit, covariance=covariance, seconds=float("inf"))
    same(odd, again(odd))
    assert again((float("nan"), -np.inf, np.float64(-0.0)))[1:] == (-np.inf, -0.0)


def test_a_class_of_the_users_is_passed_in(tmp_path: Path, small_fit: jaxid.Fit) -> None:
    fit = dataclasses.replace(small_fit, loop=small_fit.loop.add(Hose(joint=1, pull=0.25)))
    fit.save(tmp_path / "fit.jaxid")
    with pytest.raises(SaveError, match=r"your class Hose .*classes=\[Hose\]"):
        jaxid.load(tmp_path / "fit.jaxid")
    same(fit, jaxid.load(tmp_path / "fit.jaxid", classes=[Hose]))


def test_a_class_of_the_users_may_have_moved(small_fit: jaxid.Fit) -> None:
    fit = dataclasses.replace(small_fit, loop=small_fit.loop.add(Hose(joint=1, pull=0.25)))
    elsewhere = type("Hose", (Hose,), {"__module__": "their_other_file"})
    assert type(again(fit, (elsewhere,)).loop.effects[-1]) is elsewhere


def test_code_is_not_saved(tmp_path: Path, small_fit: jaxid.Fit) -> None:
    with pytest.raises(SaveError, match=r"result\.method is .* cannot be stored"):
        dataclasses.replace(small_fit, method=lambda: 1).save(tmp_path / "fit.jaxid")
    with pytest.raises(SaveError, match="only numbers can be saved"):
        archive.pack({"a": np.array([object()])})
    assert not list(tmp_path.iterdir())


def test_the_first_format_stays_readable() -> None:
    fit = jaxid.load(FIRST_FORMAT)
    assert fit.loop.names == ("M", "Fv1", "Fc1", "offset1")
    # It held the name.
    assert fit.loop.held == {("effects", 1, "smoothing")}
    assert fit.loop.held_names == {"eps1"}
    assert fit.status is jaxid.Status.converged
    assert fit.theta == pytest.approx([99.26, 221.1, 6.454, 0.652], rel=1e-3)
    assert jaxid.compare(fit, fit.recordings).errors.shape == (3, 1)


def test_a_field_of_older_diagnoses_is_dropped() -> None:
    kept = {"tests": 3.0}
    assert jaxid.discovery.Diagnosis.fields_of_format({"pair": (), **kept}, 4) == kept
    assert jaxid.discovery.Diagnosis.fields_of_format(kept, archive.FORMAT) == kept


def test_it_opens_without_jaxid(tmp_path: Path, small_fit: jaxid.Fit) -> None:
    small_fit.save(tmp_path / "fit.jaxid")
    with np.load(tmp_path / "fit.jaxid") as arrays:
        manifest = json.loads(arrays["manifest.json"])
        covariance = arrays[str(manifest["objects"][-1]["fields"]["covariance"]["array"])]
    assert manifest["format"] == archive.FORMAT
    assert manifest["versions"]["jaxid-robotics"]
    np.testing.assert_array_equal(covariance, small_fit.covariance)


def test_no_two_classes_share_a_name() -> None:
    ours = [c for c in saved._below(eqx.Module) if c.__module__.startswith("jaxid.")]
    names = [c.__name__ for c in ours]
    assert len(names) == len(set(names))
