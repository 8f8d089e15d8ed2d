"""What a container leaves a process: fewer processors and less memory than the machine has."""

import pytest

from ngpt.system import limits

MACHINE = 8 * 2**30


@pytest.fixture
def container(tmp_path, monkeypatch):
    """The limits in a container, by its groups and their files, on a machine of 12 processors and 8 GiB."""
    monkeypatch.setattr(limits, "_GROUPS", tmp_path / "cgroup")
    monkeypatch.setattr(limits, "_OWN_GROUPS", tmp_path / "own")
    monkeypatch.setattr(limits, "_visible", lambda: 12)
    monkeypatch.setattr(limits, "_physical", lambda: MACHINE)
    monkeypatch.setattr(limits, "address_space", lambda: None)
    monkeypatch.setattr(limits, "_most", None)

    def make(own, files):
        limits._quota.cache_clear()
        (tmp_path / "own").write_text(own)
        for name, text in files.items():
            file = tmp_path / "cgroup" / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(text)
        return limits.processors(), limits.memory()

    yield make
    limits._quota.cache_clear()


VERSION_1 = "5:cpu,cpuacct:/docker/1f\n3:memory:/docker/1f\n1:name=systemd:/\n"  # the paths are those of the host
QUOTA, PERIOD, MEMORY = "cpu/cpu.cfs_quota_us", "cpu/cpu.cfs_period_us", "memory/memory.limit_in_bytes"


@pytest.mark.parametrize(
    ("own", "files", "processors", "memory"),
    [
        ("", {}, 12, MACHINE),
        ("0::/\n", {"cpu.max": "max 100000\n", "memory.max": "max\n"}, 12, MACHINE),
        ("0::/a/b\n", {"a/cpu.max": "400000 100000", "a/b/cpu.max": "max 100000", "a/memory.max": "99"}, 4, 99),
        ("0::/a/b\n", {"a/cpu.max": "150000 100000", "a/memory.max": "99", "memory.max": "max"}, 2, 99),
        ("0::/a\n", {"a/cpu.max": "10000 100000"}, 1, MACHINE),
        (VERSION_1, {QUOTA: "250000", PERIOD: "100000", MEMORY: "99"}, 3, 99),
        (VERSION_1, {QUOTA: "-1", PERIOD: "100000", MEMORY: str(2**63 - 4096)}, 12, MACHINE),
    ],
)
def test_limits_are_those_of_the_groups(container, own, files, processors, memory):
    assert container(own, files) == (processors, memory)
    assert limits.limited() == (processors < 12)
