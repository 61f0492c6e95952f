import subprocess
import sys
from pathlib import Path

from benchmarks.city import parts_mb

HELD_MB = 60
_SESSION = """
import multiprocessing

def work(pipe):
    held = bytearray(b"x" * {mb} * 2**20)
    pipe.send("held")
    pipe.recv()

def learn(pipe):
    multiprocessing.set_start_method("forkserver", force=True)
    worker = multiprocessing.Process(target=work, args=(pipe,))
    worker.start()
    worker.join()

if __name__ == "__main__":
    ours, theirs = multiprocessing.Pipe()
    learner = multiprocessing.get_context("spawn").Process(target=learn, args=(theirs,))
    learner.start()
    print(ours.recv(), flush=True)
    input()
    ours.send("end")
    learner.join()
"""


def test_memory_is_attributed_to_the_parts_of_a_session(tmp_path: Path) -> None:
    script = tmp_path / "session.py"
    script.write_text(_SESSION.replace("{mb}", str(HELD_MB)))
    session = subprocess.Popen([sys.executable, script], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert session.stdout is not None
    session.stdout.readline()
    parts = parts_mb(session.pid)
    session.communicate(b"\n")
    assert HELD_MB < parts["workers"] < HELD_MB + 100
    for part in ("session", "learner", "fork server", "others"):
        assert 1 < parts[part] < HELD_MB, part
    assert sum(parts_mb(session.pid).values()) == 0  # it has ended
