"""`jaxid inspect` and `jaxid diagnose`, and logs as they are: gaps, blanks, jitter, other names."""

import json
import tomllib
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

import jaxid
from jaxid.cli import app
from jaxid.cli.describing import guess
from jaxid.errors import JaxidWarning, RecordingError

DEMO = Path(jaxid.__file__).parent / "demo" / "hidden"
FIT_1, FIT_2 = (str(DEMO / f"{name}.csv") for name in ("fit_1", "fit_2"))


def run(*arguments):
    """The command's result; an exception that it does not turn into a sentence is raised."""
    return CliRunner().invoke(app, [str(a) for a in arguments], catch_exceptions=False)


def log(path, change=None):
    """The first bundled recording with a laboratory's names, in degrees, ms and amperes."""
    table = pd.read_csv(FIT_1)
    made = pd.DataFrame({"stamp": 1e3 * table.time})
    for j in (1, 2):
        made[f"pos{j}"] = np.degrees(table[f"q_{j}"])
        made[f"cur{j}"] = table[f"tau_{j}"] / 6.2
        made[f"des{j}"] = np.degrees(table[f"q_ref_{j}"])
    made = made if change is None else change(made)
    made.to_csv(path, index=False)
    return path


def test_what_is_in_a_recording_is_what_was_put_there(tmp_path):
    time = np.arange(0.0, 10.0, 0.01)
    q = np.column_stack([np.sin(time), 0.2 * np.clip(time - 2, 0, 3)])
    tau = np.column_stack([3 * np.cos(time), np.sign(time - 5)])
    one = jaxid.Recording.from_arrays(time, q, tau, name="one")
    other = jaxid.Recording.from_arrays(time, q + 1e-5 * tau, 2 * tau, name="other")
    found = jaxid.inspect([one, other])
    row = found.joints.loc[("one", 1)]
    assert row["from"] == pytest.approx(-1, abs=1e-3)
    assert row["speed"] == pytest.approx(1, rel=0.02)
    assert row["turns"] == 3
    assert row["tau peak"] == pytest.approx(3)
    # Of ten seconds the second joint moves for three, and a little more through the low-pass.
    assert found.joints.loc[("one", 2), "rest %"] == pytest.approx(70, abs=10)
    assert found.signals.loc["one", "Hz"] == pytest.approx(100)
    assert found.repeats == (("one", "other"),)
    assert any("joint 2 rarely reverses" in note for note in found.notes)
    assert "one and other repeat" in repr(found)
    assert "one and other repeat" in found._repr_html_()
    assert json.loads(json.dumps(found.to_dict()))["repeats"] == [["one", "other"]]


def look(q, tau, q_ref=None, time=None):
    """What is found in one recording of a joint, 1 kHz, and its notes as one text."""
    time = 1e-3 * np.arange(len(q)) if time is None else time
    found = jaxid.inspect(jaxid.Recording.from_arrays(time, q, tau, q_ref=q_ref, gaps="allow"))
    return found.joints.iloc[0], "\n".join(found.notes)


@pytest.mark.parametrize(
    ("count", "every", "law"),
    [(1e-4, 1, "each"), (1e-4, 4, "every 4"), (None, 1, "-"), (None, 5, "every 5")],
)
def test_a_sampled_law_shows_in_its_torque(count, every, law):
    time = 1e-3 * np.arange(3000)
    q = 0.97 * np.sin(6 * time - 0.05)
    read = q if count is None else count * np.round(q / count)
    tau = (100 * (np.sin(6 * time) - read))[np.arange(3000) // every * every]
    row, notes = look(read, tau)
    assert row["law"] == law
    assert (f"control.Sampled(every={1e-3 * every:.4g})" in notes) == (every > 1)
    # The step of the encoder, to the digits that rounding leaves.
    assert row["q step"] == pytest.approx(0.0 if count is None else count, rel=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_noise_of_its_own_is_no_sampled_law(seed):
    rng = np.random.default_rng(seed)
    time = 1e-3 * np.arange(3000)
    q, tau = np.sin(6 * time), np.cos(6 * time)
    noise = rng.normal(size=(2, 3000))
    assert look(q + 1e-4 * noise[0], tau + 0.01 * noise[1])[0]["law"] == "-"


def test_steps_are_found_through_the_digits_of_a_file():
    count = 2 * np.pi / 40_000
    time = 1e-3 * np.arange(3000)
    # As written with eight digits: moves of up to 300 counts, each off by some 1e-4 of a count.
    q = np.round(count * np.round(5 * np.sin(9 * time) / count), 8)
    row, notes = look(q, np.cos(time))
    assert row["q step"] == pytest.approx(count, rel=1e-6)
    assert "encoder counts" in notes
    row, notes = look(np.round(np.sin(9 * time), 5), np.cos(time))
    assert row["q step"] == pytest.approx(1e-5, rel=1e-6)
    assert "digits of the file" in notes


def test_a_reference_that_repeats_or_is_held_is_told():
    time = 1e-3 * np.arange(4000)
    wave = np.sin(2 * np.pi * time / 0.9) + 0.3 * np.sin(4 * np.pi * time / 0.9 + 1)
    _, notes = look(wave + 1e-3 * time, np.cos(time), q_ref=wave)
    assert "the reference of recording repeats every 0.9 s, 4.44 times" in notes
    _, notes = look(
        wave + 1e-3 * time, np.cos(time), q_ref=np.sin(time**2)[np.arange(4000) // 8 * 8]
    )
    assert "repeats every" not in notes
    assert "is held for 8 samples (8 ms)" in notes


def test_gaps_are_counted():
    time = np.delete(1e-3 * np.arange(3000), [*range(500, 700), *range(2000, 2400)])
    _, notes = look(np.sin(time), np.cos(time), time=time)
    assert "has 2 gaps, the longest of 0.401 s after 1.999 s" in notes


def test_references_of_another_size_or_at_other_samples():
    def of(name, time, size):
        wave = size * np.sin(time**2)
        return jaxid.Recording.from_arrays(time, wave, np.cos(time), q_ref=wave, name=name)

    time = np.arange(0, 5, 0.005)
    several = [of("a", time, 1), of("half", time, 0.5), of("late", time + 0.0021, 1)]
    assert jaxid.inspect(several).repeats == (("a", "late"),)


@pytest.mark.parametrize(
    ("names", "q", "tau"),
    [
        ("t,q1,q2,qd1,qd2,tau1,tau2", ["q1", "q2"], ["tau1", "tau2"]),
        ("stamp,pos_2,pos_1,effort_1,effort_2", ["pos_1", "pos_2"], ["effort_1", "effort_2"]),
        ("Time,Position[1],Position[2],Current[1],Current[2]", None, None),
        ("timestamp,angle,torque", ["angle"], ["torque"]),
        ("robot/stamp,robot/qpos_1,robot/qpos_2,robot/effort_1,robot/effort_2", None, None),
        ("t_ms,pos_meas1,pos_meas2,tau_con1,tau_con2,tau_fric1,tau_fric2", None, None),
        ("dt,q,tau,G", ["q"], ["tau"]),
        ("t,q_goal,q,dq,pwm,volts", ["q"], ["pwm"]),
        ("time,actual_q_0,actual_q_1,actual_current_0,actual_current_1", None, None),
    ],
)
def test_columns_are_guessed_by_what_logs_call_them(names, q, tau):
    listed = names.split(",")
    found = guess(listed)
    assert found["time"] == listed[0]
    assert found["q"] == (q or listed[1:3])
    assert found["tau"] == (tau or listed[3:5])


@pytest.mark.parametrize("names", ["a,b,c", "time,q1,q2,tau1", "q1,tau1"])
def test_nothing_is_guessed_where_a_signal_is_not_there(names):
    assert guess(names.split(",")) == {}


def test_a_log_is_inspected_described_and_read(tmp_path):
    path, toml = log(tmp_path / "run.csv"), tmp_path / "log.toml"
    figure, out = tmp_path / "run.html", tmp_path / "run.json"
    seen = run("inspect", path, "--write", toml, "--unit", "q=deg", "--plot", figure, "--json", out)
    assert seen.exit_code == 0, seen.stderr
    assert "time=stamp  q=pos1,pos2  tau=cur1,cur2  q_ref=des1,des2" in seen.stdout
    assert all(len(x) <= 100 for x in seen.stdout.splitlines() if x.startswith("run "))
    assert "plotly" in figure.read_text(encoding="utf-8").lower()
    assert json.loads(out.read_text())["recordings"][0]["samples"] == 1001
    told = tomllib.loads(toml.read_text(encoding="utf-8"))
    assert told["columns"]["q"] == ["pos1", "pos2"]
    # As a user edits it.
    text = toml.read_text(encoding="utf-8")
    text = text.replace('time = "s"', 'time = "ms"').replace('["rad", "rad"]', '["deg", "deg"]')
    text = text.replace('"cur1", "cur2"', '"cur1*6.2", "cur2*6.2"')
    toml.write_text(text, encoding="utf-8")
    options = ("--robot", "scara", "--method", "idim")
    one, other = tmp_path / "one.json", tmp_path / "other.json"
    assert run("fit", path, *options, "--log", toml, "--json", one).exit_code == 0
    assert run("fit", FIT_1, *options, "--json", other).exit_code == 0
    values = [json.loads(f.read_text())["parameters"]["ZZ1r"]["value"] for f in (one, other)]
    assert values[0] == pytest.approx(values[1], rel=1e-6)


def test_a_description_that_says_something_else_is_refused(tmp_path):
    toml = tmp_path / "log.toml"
    for text, says in (
        ("colums = {}", "'colums'"),
        ("gaps = 3", "'gaps'"),
        ("= 1", "is not valid TOML"),
    ):
        toml.write_text(text)
        refused = run("fit", FIT_1, "--robot", "scara", "--log", toml)
        assert refused.exit_code == 2
        assert says in refused.stderr
        assert len(refused.stderr.splitlines()) == 1


def test_an_option_goes_before_the_description_which_allows_no_gap_that_is_not_there(tmp_path):
    def cut(table):
        return table.drop(range(100, 200))

    path, toml = log(tmp_path / "run.csv", cut), tmp_path / "log.toml"
    assert run("inspect", path, "--write", toml).exit_code == 0
    assert 'gaps = "allow"' in toml.read_text(encoding="utf-8")
    refused = run("fit", path, "--robot", "scara", "--log", toml, "--gaps", "refuse")
    assert refused.exit_code == 2
    assert "has a gap of" in refused.stderr
    assert run("inspect", FIT_1, "--write", toml).exit_code == 0
    assert 'gaps = "refuse"' in toml.read_text(encoding="utf-8")


def test_blank_cells_are_refused_by_line_and_left_out_if_told(tmp_path):
    def blank(table):
        table.loc[[40, 41, 300], "pos2"] = np.nan
        return table

    path = log(tmp_path / "run.csv", blank)
    names = {"time": "stamp", "q": ["pos1", "pos2"], "tau": ["cur1", "cur2"]}
    units = {"time": "ms", "q": "deg"}
    with pytest.raises(RecordingError, match=r"pos2, line 42 is empty .*--drop-nan"):
        jaxid.read(path, columns=names, units=units)
    with pytest.warns(JaxidWarning, match=r"3 of 1001 samples are left out.*line 42"):
        (less,) = jaxid.read(path, columns=names, units=units, nan="drop")
    assert less.samples == 998


def test_times_of_a_logger_are_told_and_evened(tmp_path):
    rng = np.random.default_rng(1)

    def jitter(table):
        table["stamp"] += rng.uniform(-3, 3, len(table))
        return table

    path = log(tmp_path / "run.csv", jitter)
    names = {"time": "stamp", "q": ["pos1", "pos2"], "tau": ["cur1", "cur2"]}
    units = {"time": "ms", "q": "deg"}
    with pytest.warns(JaxidWarning, match=r"jitter by .* ms about .*--clock even"):
        jaxid.read(path, columns=names, units=units)
    (even,) = jaxid.read(path, columns=names, units=units, clock="even")
    np.testing.assert_allclose(even.time, pd.read_csv(FIT_1).time, atol=4e-4)
    # Samples that are uneven in truth are no reason to warn.
    time = np.cumsum(rng.uniform(0.006, 0.014, 800))
    jaxid.Recording.from_arrays(time, np.sin(time), np.cos(3 * time))


@pytest.mark.parametrize("late", [[-0.2, 0.2], [0.0, 0.6]])
def test_missing_samples_leave_holes_in_even_times(tmp_path, late):
    rng = np.random.default_rng(2)
    gone = [100, 101, 350, *range(500, 504)]

    def jitter(table):
        table["stamp"] += 10 * rng.uniform(*late, len(table))
        return table.drop(index=gone)

    path = log(tmp_path / "run.csv", jitter)
    names = {"time": "stamp", "q": ["pos1", "pos2"], "tau": ["cur1", "cur2"]}
    given = {"columns": names, "units": {"time": "ms", "q": "deg"}, "clock": "even"}
    with pytest.warns(
        JaxidWarning, match="7 of 1001 samples seem to be missing, first after line 10"
    ):
        (even,) = jaxid.read(path, **given)
    true = pd.read_csv(FIT_1).time.drop(index=gone)
    np.testing.assert_allclose(np.diff(even.time), np.diff(true), atol=1e-5)
    path = log(tmp_path / "long.csv", lambda table: jitter(table).drop(index=range(600, 660)))
    with (
        pytest.warns(JaxidWarning, match="67 of 1001"),
        pytest.raises(RecordingError, match=r"has a gap of 0\.6"),
    ):
        jaxid.read(path, **given)


def test_lines_are_counted_as_an_editor_does(tmp_path):
    path = tmp_path / "run.csv"
    lines = Path(FIT_1).read_text().splitlines()
    lines[5] = lines[5].replace(lines[5].split(",")[1], "high")
    path.write_text("# a comment\n\n" + "\n".join(lines) + "\n")
    with pytest.raises(RecordingError, match="line 8 holds 'high'"):
        jaxid.read(path)


def test_diagnose_ranks_what_the_bundled_arm_lacks(tmp_path):
    out = tmp_path / "ranking.json"
    found = run("diagnose", FIT_1, FIT_2, "--robot", "scara", "--json", out)
    assert found.exit_code == 0, found.stderr
    ranking = json.loads(out.read_text())["ranking"]
    assert ranking[0]["p_value"] < 0.01
    assert ranking[0]["effect"] in found.stdout
