"""What `make durations` writes: processor seconds of files and of dear cases, those of programs included."""

import json
import subprocess
import sys
from types import SimpleNamespace

import durations


def test_files_that_ran_are_written_anew_and_others_stay(tmp_path):
    path = tmp_path / "durations.json"
    path.write_text(json.dumps({"files": {"a.py": 9, "b.py": 5}, "cases": {"a.py::gone": 9, "b.py::dear": 5}}))
    written = durations.Written(path)
    for case, seconds in (("a.py::dear", 1.5), ("a.py::dear", 0.5), ("a.py::cheap", 0.1)):
        written.pytest_runtest_logreport(SimpleNamespace(nodeid=case, processor=seconds))
    written.pytest_sessionfinish()
    found = json.loads(path.read_text())
    assert found == {"files": {"b.py": 5, "a.py": 2.1}, "cases": {"b.py::dear": 5, "a.py::dear": 2.0}}
    assert list(found["files"]) == ["b.py", "a.py"], "the dearest first"


def test_programs_count():
    durations.pytest_runtest_logstart()
    subprocess.run([sys.executable, "-c", "import time\nwhile time.process_time() < 0.2: pass"], check=True)
    hook = durations.pytest_runtest_makereport()
    next(hook)
    try:
        hook.send(SimpleNamespace())
    except StopIteration as done:
        # Clocks of processes tick in hundredths.
        assert 0.15 < done.value.processor < 2
