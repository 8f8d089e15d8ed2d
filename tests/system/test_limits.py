"""What a container leaves a process: fewer processors and less memory than the machine has."""

import pytest

from ngpt.system import limits

MACHINE = 8 * 2**30


@pytest.fixture
def container(tmp_path, monkeypatch):
    """Makes a container on a machine of 12 processors and 8 GiB: its groups, and what their files say."""
    monkeypatch.setattr(limits, "_GROUPS", tmp_path / "cgroup")
    monkeypatch.setattr(limits, "_OWN_GROUPS", tmp_path / "own")
    monkeypatch.setattr(limits, "_visible", lambda: 12)
    monkeypatch.setattr(limits, "_physical", lambda: MACHINE)
    monkeypatch.setattr(limits, "address_space", lambda: None)
    monkeypatch.setattr(limits, "_most", None)

    def make(own, **files):
        limits._quota.cache_clear()
        (tmp_path / "own").write_text(own)
        for name, text in files.items():
            file = tmp_path / "cgroup" / name.replace("__", "/").replace("_max", ".max")
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(text)

    yield make
    limits._quota.cache_clear()


def test_without_groups_the_machine_counts(container):
    assert (limits.processors(), limits.memory(), limits.limited()) == (12, MACHINE, False)
    container("0::/\n", cpu_max="max 100000\n", memory_max="max\n")
    assert (limits.processors(), limits.memory(), limits.limited()) == (12, MACHINE, False)


@pytest.mark.parametrize(("quota", "expected"), [("400000 100000", 4), ("150000 100000", 2), ("10000 100000", 1)])
def test_groups_of_version_2(container, quota, expected):
    container("0::/a/b\n", a__cpu_max=quota, a__b__cpu_max="max 100000", a__memory_max=str(2**31), memory_max="max")
    assert (limits.processors(), limits.memory(), limits.limited()) == (expected, 2**31, True)


def test_groups_of_version_1_whose_path_is_the_hosts(container, tmp_path):
    container("5:cpu,cpuacct:/docker/1f\n3:memory:/docker/1f\n1:name=systemd:/\n")
    for name, text in {
        "cpu/cpu.cfs_quota_us": "250000",
        "cpu/cpu.cfs_period_us": "100000",
        "memory/memory.limit_in_bytes": str(2**30),
    }.items():
        (tmp_path / "cgroup" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "cgroup" / name).write_text(text)
    assert (limits.processors(), limits.memory()) == (3, 2**30)
    (tmp_path / "cgroup/cpu/cpu.cfs_quota_us").write_text("-1")
    (tmp_path / "cgroup/memory/memory.limit_in_bytes").write_text(str(2**63 - 4096))
    limits._quota.cache_clear()
    assert (limits.processors(), limits.memory()) == (12, MACHINE)
