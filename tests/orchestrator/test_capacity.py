"""How many trials fit on a machine."""

from pathlib import Path

import pytest

from recrl.orchestrator.capacity import trials_at_once, trials_on_gpus, usable_cores


def test_at_least_one_trial_fits_and_no_more_than_allowed() -> None:
    assert trials_at_once(cpus_per_trial=1e6, max_concurrent=None) == 1
    assert trials_at_once(cpus_per_trial=1e-3, max_concurrent=3) == 3


@pytest.mark.parametrize(
    ("gpus", "of_a_trial", "trials"),
    [
        (0, 1.0, 0),
        (3, 1.0, 3),
        (3, 2.0, 1),
        (2, 0.5, 4),
        (2, 0.6, 2),
        (2, 0.4, 4),
        (10, 0.1, 100),
        (1, 0.3, 3),
    ],
)
def test_trials_share_a_gpu_but_use_no_parts_of_two(gpus: int, of_a_trial: float, trials: int) -> None:
    assert trials_on_gpus(gpus, of_a_trial) == trials


VERSION_2 = "0::/slurm/job_7/step_0\n"
VERSION_1 = "9:memory:/a\n5:cpu,cpuacct:/slurm/job_7\n0::/init.scope\n"


@pytest.mark.parametrize(
    ("groups", "quotas", "cores"),
    [
        (None, {}, 4),
        (None, {"cpu.max": "100000 100000"}, 4),  # no file says that this process is in the group
        (VERSION_2, {}, 4),
        (VERSION_2, {"slurm/job_7/step_0/cpu.max": "max 100000"}, 4),
        (VERSION_2, {"slurm/job_7/step_0/cpu.max": "300000 100000"}, 3),
        (VERSION_2, {"slurm/job_7/step_0/cpu.max": "max 100000", "slurm/job_7/cpu.max": "250000 100000"}, 2),
        (VERSION_2, {"slurm/job_8/cpu.max": "100000 100000"}, 4),  # another job
        (VERSION_2, {"slurm/cpu.max": "50000 100000"}, 1),
        ("0::/\n", {"cpu.max": "150000 100000"}, 1),  # in a container
        ("0::/../../other\n", {"cpu.max": "200000 100000"}, 2),
        (VERSION_2, {"cpu.max": "no numbers"}, 4),
        (VERSION_2, {"cpu.max": "100000 0"}, 4),
        ("not a list of groups\n", {"cpu.max": "100000 100000"}, 4),
        (VERSION_1, {"cpu/slurm/job_7/cpu.cfs_quota_us": "-1"}, 4),
        (VERSION_1, {"cpu/slurm/job_7/cpu.cfs_quota_us": "200000"}, 2),
        (VERSION_1, {"cpu/cpu.cfs_quota_us": "300000"}, 3),  # a container that sees only its own group
        (VERSION_1, {"memory/a/cpu.cfs_quota_us": "100000"}, 4),
    ],
)
def test_affinity_and_the_quotas_of_control_groups_count(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, groups: str | None, quotas: dict[str, str], cores: int
) -> None:
    monkeypatch.setattr("os.sched_getaffinity", lambda _: set(range(4)))
    listed = tmp_path / "proc/self/cgroup"
    listed.parent.mkdir(parents=True)
    if groups is not None:
        listed.write_text(groups)
    for name, text in quotas.items():
        path = tmp_path / "sys/fs/cgroup" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"{text}\n")
        if name.endswith("cfs_quota_us"):
            path.with_name("cpu.cfs_period_us").write_text("100000\n")
    assert usable_cores(tmp_path) == cores
