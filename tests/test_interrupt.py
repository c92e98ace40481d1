"""Ctrl-C during a discovery: the best model so far is given back."""

import pytest
from stories import recordings_of

import jaxid
from jaxid.discovery import search

pytestmark = pytest.mark.xdist_group("offset")


def interrupted_at(monkeypatch, case, journal, name):
    """A discovery from saved fits that is interrupted where a method of its search begins."""

    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(search.Search, name, stop)
    fit, held_out = recordings_of(case)
    return jaxid.discover(jaxid.scara(), fit, held_out, resume=journal, progress=False)


def test_the_best_model_so_far_is_given_back(monkeypatch, offset_case, offset_story):
    story, journal = offset_story
    found = interrupted_at(monkeypatch, offset_case, journal, "_predicted")
    assert found.interrupted
    assert found.verdict == "undetermined"
    assert found.sentence.startswith("The search was interrupted")
    assert found.loop.names == story.steps[0].fit.loop.names
    assert found.to_dict()["interrupted"]
    assert max(map(len, repr(found).splitlines()[1:])) <= 80


def test_after_the_fit_of_an_effect_it_is_in_the_model(monkeypatch, offset_case, offset_story):
    story, journal = offset_story
    found = interrupted_at(monkeypatch, offset_case, journal, "_without_one")
    assert found.interrupted
    assert found.fit.names == story.fit.names
    assert found.steps[-1].added.effect_name() == "torque_offset"
    # Its own diagnosis had not been made; the one before has the noise floor.
    assert found.diagnosis is not None


def test_before_the_first_fit_there_is_nothing(monkeypatch, offset_case, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        interrupted_at(monkeypatch, offset_case, tmp_path / "new", "start")
