"""Campaigns: killed at any moment and begun again, they end as if nothing had happened."""

import os
import subprocess
import sys
import textwrap
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jaxid.errors import FitError, SaveError
from jaxid.storage.campaign import Campaign, Failed

# One process imports jaxid, and one child after the other works in the folder until it is killed.
KILLED_AGAIN_AND_AGAIN = """
    import os, random, signal, sys, time
    import numpy as np
    from jaxid.storage.campaign import Campaign

    folder, log, kills = sys.argv[1], sys.argv[2], int(sys.argv[3])

    def draw(k):
        os.write(out, f"{k}\\n".encode())
        rng = np.random.default_rng([7, k])
        time.sleep(0.004)
        return {"k": k, "draw": rng.normal(size=(50, 8))}

    def work():
        with Campaign(folder, {"seed": 7}) as campaign:
            for _ in campaign.run(draw, {f"draw {k}": k for k in range(100)}):
                pass

    out = os.open(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    moments = random.Random(3)
    for attempt in range(kills + 1):
        child = os.fork()
        if child == 0:
            work()
            os._exit(0)
        if attempt < kills:
            time.sleep(moments.uniform(0.0, 0.3))
            os.kill(child, signal.SIGKILL)
        ended = os.waitpid(child, 0)[1]
    sys.exit(ended)
"""


def values(found: Any) -> dict[str, Any]:
    """Results as what can be compared to the bit."""
    return {name: (x["k"], x["draw"].tobytes()) for name, x in found}


def draw(k: int) -> dict[str, Any]:
    rng = np.random.default_rng([7, k])
    return {"k": k, "draw": rng.normal(size=(50, 8))}


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs processes that fork")
def test_killed_at_random_moments_it_gives_the_same(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(textwrap.dedent(KILLED_AGAIN_AND_AGAIN))
    arguments = [str(script), str(tmp_path / "killed"), str(tmp_path / "log"), "12"]
    subprocess.run([sys.executable, *arguments], check=True, timeout=120)
    pieces = {f"draw {k}": k for k in range(100)}

    def never(k: int) -> None:
        raise AssertionError("done already")

    with Campaign(tmp_path / "killed", {"seed": 7}) as campaign:
        resumed = dict(campaign.run(never, pieces))
    assert campaign.damaged == []
    assert len(list((tmp_path / "killed").glob("*.piece"))) == 100
    # Each death loses what it was at, which is begun again, and nothing else is.
    begun = len((tmp_path / "log").read_text().splitlines())
    assert 100 <= begun <= 112
    assert not list((tmp_path / "killed").glob(".*.part"))
    with Campaign(None, {"seed": 7}) as nowhere:
        undisturbed = dict(nowhere.run(draw, pieces))
    assert values(resumed.items()) == values(undisturbed.items())


def test_what_is_there_is_not_done_again(tmp_path: Path) -> None:
    done = []

    def counted(k: int) -> int:
        done.append(k)
        return k * k

    for last in (3, 6, 6):
        with Campaign(tmp_path / "c", {}) as campaign:
            found = dict(campaign.run(counted, {str(k): k for k in range(last)}))
    assert found == {str(k): k * k for k in range(6)}
    assert done == list(range(6))


def test_a_damaged_piece_is_set_aside_and_done_again(tmp_path: Path) -> None:
    with Campaign(tmp_path / "c", {}) as campaign:
        first = values(campaign.run(draw, {"a": 1, "b": 2}))
        path = campaign.path("a")
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    with Campaign(tmp_path / "c", {}) as campaign:
        assert values(campaign.run(draw, {"a": 1, "b": 2})) == first
        assert campaign.damaged == ["a"]
    assert path.with_suffix(".damaged").read_bytes() == content


def test_a_piece_under_another_name_is_not_taken(tmp_path: Path) -> None:
    with Campaign(tmp_path / "c", {}) as campaign:
        dict(campaign.run(draw, {"a": 1, "b": 2}))
        campaign.path("a").write_bytes(campaign.path("b").read_bytes())
    with Campaign(tmp_path / "c", {}) as campaign:
        assert dict(campaign.run(draw, {"a": 1}))["a"]["k"] == 1
        assert campaign.damaged == ["a"]


def test_a_piece_that_fails_is_counted_and_named(tmp_path: Path) -> None:
    tries = []

    def work(k: int) -> int:
        tries.append(k)
        if k == 1:
            raise FitError("the recording holds no motion")
        return 10 // k

    for _ in range(2):
        with Campaign(tmp_path / "c", {}) as campaign:
            found = dict(campaign.run(work, {"one": 1, "none": 0, "five": 5}))
        assert found["five"] == 2
        assert found["one"] == Failed("FitError: the recording holds no motion")
        assert "ZeroDivisionError" in found["none"].reason
    # A verdict is a result like any other.
    assert tries == [1, 0, 5]


def test_a_mistake_in_the_program_is_raised(tmp_path: Path) -> None:
    def work(k: int) -> int:
        return [][k]

    with Campaign(tmp_path / "c", {}) as campaign, pytest.raises(IndexError):
        dict(campaign.run(work, {"a": 1}))
    assert not list((tmp_path / "c").glob("*.piece"))


def test_another_plan_is_refused(tmp_path: Path) -> None:
    with Campaign(tmp_path / "c", {"seed": 7, "x": np.ones(3)}) as campaign:
        dict(campaign.run(draw, {"a": 1}))
    with Campaign(tmp_path / "c", {"seed": 7, "x": np.ones(3)}):
        pass
    with pytest.raises(SaveError, match=r"different: seed, x\)"):
        Campaign(tmp_path / "c", {"seed": 8, "x": np.zeros(3)}).__enter__()


def test_another_version_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with Campaign(tmp_path / "c", {}):
        pass
    monkeypatch.setattr("jaxid.storage.archive.versions", lambda: {"jaxid-robotics": "9.1"})
    with pytest.raises(SaveError, match="jaxid-robotics"):
        Campaign(tmp_path / "c", {}).__enter__()


def test_one_process_at_a_time(tmp_path: Path) -> None:
    with (
        Campaign(tmp_path / "c", {}),
        pytest.raises(SaveError, match="another process works in this folder"),
    ):
        Campaign(tmp_path / "c", {}).__enter__()
    with Campaign(tmp_path / "c", {}):
        pass


def test_folders_that_cannot_be_used(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    for folder in (tmp_path / "file", tmp_path / "absent" / "c", "nul\0byte"):
        with pytest.raises(SaveError, match="cannot be used"):
            Campaign(folder, {}).__enter__()
    (tmp_path / "c").mkdir()
    (tmp_path / "c" / "plan.json").write_text("[" * 5000)
    with pytest.raises(SaveError, match="not a plan of a campaign"):
        Campaign(tmp_path / "c", {}).__enter__()


def test_names_stay_in_the_folder(tmp_path: Path) -> None:
    names = [
        "../../etc/passwd",
        "<script>",
        "a/b",
        "$(touch x); rm *",
        "é" * 300,
        "",
        "..",
        "A",
        "a",
    ]
    with Campaign(tmp_path / "c", {}) as campaign:
        found = dict(campaign.run(len, {name: name for name in names}))
    assert found == {name: len(name) for name in names}
    assert {p.parent for p in tmp_path.rglob("*.piece")} == {tmp_path / "c"}
    assert len(list(tmp_path.rglob("*.piece"))) == len(names)


# --- several processes ----------------------------------------------------------------------------


def square(k: int) -> int:
    """In a worker; the number 13 takes its process down with it, 4 fails for a reason."""
    if k == 13:
        os._exit(1)
    if k == 4:
        raise FitError("four")
    return k * k


def test_a_worker_that_dies_takes_no_other_piece_down(tmp_path: Path) -> None:
    pieces = {f"{k}": k for k in (2, 4, 13)}
    with Campaign(tmp_path / "c", {}) as campaign:
        found = dict(campaign.run(square, pieces, jobs=2))
    assert found["2"] == 4
    assert found["4"] == Failed("FitError: four")
    assert "ended from outside" in found["13"].reason
    # The failure is not caused by the piece, so the next run tries it again.
    assert len(list((tmp_path / "c").glob("*.piece"))) == 2


def test_workers_of_a_killed_process_end(tmp_path: Path) -> None:
    script = textwrap.dedent(
        """
        import multiprocessing, os, time

        def work():
            from jaxid.storage.campaign import _end_with_parent
            _end_with_parent()
            print(os.getpid(), flush=True)
            time.sleep(60)

        if __name__ == "__main__":
            multiprocessing.get_context("spawn").Process(target=work).start()
            time.sleep(60)
        """
    )
    (tmp_path / "script.py").write_text(script)
    parent = subprocess.Popen(
        [sys.executable, str(tmp_path / "script.py")], stdout=subprocess.PIPE, text=True
    )
    assert parent.stdout is not None
    worker = int(parent.stdout.readline())
    parent.kill()
    # The worker holds the pipe's other end: that it closes says that the worker is gone.
    assert parent.stdout.read() == ""
    parent.wait()
    for _ in range(100):
        if not alive(worker):
            return
        time.sleep(0.05)
    raise AssertionError("the worker outlived its parent")


def alive(process: int) -> bool:
    """Whether there is a process of that number."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True
