"""Making training sets: the same bits however it is done, nothing lost or doubled when killed, errors recorded.

Most tests replace the rendering of a shard, which takes seconds, by a stand-in that takes none.
"""

import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ngpt.errors import NgptError
from ngpt.training.dataset import Dataset, problems, read_manifest

pytest.importorskip("safetensors")
pytest.importorskip("mitsuba")

from data_gen.cluster import cluster as dask_cluster
from data_gen.dataset import jobs
from data_gen.dataset.cameras import CameraView, Surroundings, find_view, random_view, what_shows, with_one_kernel
from data_gen.dataset.config import DatasetConfig, Files, read_config
from data_gen.scenes.load import load_scene
from data_gen.scenes.procedural import scenes
from ngpt.training.shards import write_shard

ROOT = Path(__file__).parents[2]
PAIRS = "scenes = 1\nreference_spp = 0"


def stand_in(config, job, folder, variant):
    """A shard without crops, written after a moment."""
    time.sleep(0.01)
    write_shard(Path(folder) / job.file, [], {"scene": job.scene, "crops": [], "failures": []})
    return job.file


def hashes(folder):
    return {entry["file"]: entry["sha256"] for entry in read_manifest(folder)["shards"]}


def test_configurations_can_be_read():
    for path in (ROOT / "configs").glob("data-*.toml"):
        config = read_config(path)
        # The scene files that some name do not come with us.
        assert config.files or config.plan()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("spp = [1, 4]\nscenes = 1", "at least 2"),
        ("scenes = 0", "no scenes"),
        ("scenes = 1\nsampler = 'gtp'", "unknown sampler 'gtp'"),
        ("scenes = 1\nsampler = 'primal'", "reference_method 'wcv' needs gradients, and sampler 'primal' renders none"),
        ("scene = 3", "unknown key 'scene'; did you mean 'scenes'\\? there are: seed, size"),
        ("seed = ", "cannot be read"),
        ("scenes = 1\nsights = {media = 1.0}", "set varied = true"),
        ("scenes = 1\nvaried = true\nsights = {fog = 1.0}", "no sight is called 'fog'; there are fine, hair"),
        ("scenes = 1\nvaried = true\nsights = {media = 2}", r"sights = {'media': 2}: each is the share"),
        ("scenes = 1\nadaptive = 1.5", r"adaptive = 1\.5: the share of inputs"),
        ("scenes = 1\nadaptive = 1\nspp = [2, 16]", "fewer than 32 samples cannot be shared out; spp goes up to 16"),
        ("scenes = 1\nadaptive = 1\nframes = 2", "frames of shots have even samples"),
        ("scenes = 1\nadaptive = 1\nsampler = 'bdpt'", "the samples of 'bdpt' depend on each other; use 'gpt'"),
        ("scenes = 1\nsubpixels = 3", "subpixels = 3: 1, 2, 4"),
        ("scenes = 1\nsubpixels = 2\nsampler = 'bdpt'\nreference_method = 'primal'", "has no subpixels"),
        ("scenes = 1\n[samplers.gpt]\nshift = 'x'", "sampler 'gpt', option 'shift': 'x' is not allowed"),
        ("scenes = 1\n[samplers.ppm]\nradius = 1", r"samplers\.ppm: this set is rendered by 'gpt'"),
        ("spp = 3", r"spp = 3: must be a list of 2 whole numbers, like \[2, 64\]"),
        ("[[files]]\npattern = 3\ncrops = 1", r"\[files\]\[0\]: pattern = 3: must be a string"),
        ("[[files]]\ncrops = 1", r"\[files\]\[0\]: lacks 'pattern'"),
        ("files = 1", "files = 1: must be a list of tables"),
        (f"{PAIRS}\ninputs = 3", "set inputs = 2"),
        (f"{PAIRS}\ninputs = 2\nframes = 2", "learnt from references"),
        (f"{PAIRS}\ninputs = 2\nadaptive = 0.5\nspp = [2, 64]", "halves are alike"),
        (f"{PAIRS}\ninputs = 2\nsampler = 'primal'", "renders no gradients"),
        ("scenes = 1\nreference_spp = 2", "at least 4, two for each of its halves; or 0, for pairs"),
    ],
)
def test_bad_configurations(tmp_path, text, message):
    (tmp_path / "c.toml").write_text(text)
    with pytest.raises(NgptError, match=rf"c\.toml: .*{message}"):
        read_config(tmp_path / "c.toml")


@pytest.mark.parametrize("way", ["one process", "threads", "parts"])
def test_a_set_is_the_same_however_it_is_made(tmp_path, monkeypatch, way):
    monkeypatch.setattr(jobs, "make_shard", stand_in)
    config, folder = DatasetConfig(scenes=5, crops=3, crops_per_shard=2), tmp_path / "again"
    jobs.generate(config, tmp_path / "whole", jobs.Serial())
    for i in range(3 if way == "parts" else 1):
        with ThreadPoolExecutor(3) if way == "threads" else jobs.Serial() as executor:
            jobs.generate(config, folder, executor, **({"shard": (i, 3)} if way == "parts" else {}))
    assert hashes(folder) == hashes(tmp_path / "whole") and len(hashes(folder)) == len(config.plan()) == 10
    assert problems(folder) == []


def test_goes_on_where_it_stopped(tmp_path, monkeypatch):
    monkeypatch.setattr(jobs, "make_shard", stand_in)
    config = DatasetConfig(scenes=4, crops=1)
    jobs.generate(config, tmp_path, jobs.Serial())
    before = hashes(tmp_path)
    lost = next((tmp_path / "shards").iterdir())
    lost.unlink()
    (tmp_path / "shards" / ".half-written.safetensors").write_bytes(b"x")  # what a killed process leaves behind
    calls = []
    jobs.generate(config, tmp_path, jobs.Serial(), progress=lambda done, total: calls.append((done, total)))
    assert calls == [(3, 4), (4, 4)]
    assert hashes(tmp_path) == before
    with pytest.raises(NgptError, match="seed differ"):
        jobs.generate(replace(config, seed=1), tmp_path, jobs.Serial())


def test_disk_full_stops_cleanly(tmp_path, monkeypatch):
    def full(config, job, folder, variant):
        if job.scene == "made-00002":
            raise NgptError(f"{job.file}: cannot be written: No space left on device")
        return stand_in(config, job, folder, variant)

    monkeypatch.setattr(jobs, "make_shard", full)
    with pytest.raises(NgptError, match="No space left"):
        jobs.generate(DatasetConfig(scenes=4, crops=1), tmp_path, jobs.Serial())
    assert len(hashes(tmp_path)) == 2


def test_scene_files_as_sources(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "scene.xml").touch()
    box = [[0, 0, 0], [1, 1, 1]]
    config = DatasetConfig(files=(Files(str(tmp_path / "*" / "*.xml"), 3, boxes={"a-scene": box}),))
    assert [(job.scene, job.crops, job.box) for job in config.plan()] == [("a-scene", (0, 1, 2), box)]
    with pytest.raises(NgptError, match="no scene file matches"):
        DatasetConfig(files=(Files(str(tmp_path / "nothing"), 3),)).plan()


def test_a_scene_can_be_saved_by_its_seed(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["scenes", "5", str(tmp_path / "new")])
    assert scenes.main() == 0 and (tmp_path / "new/scene.xml").is_file()
    assert scenes.main() == 2 and "exists and is not an empty folder" in capsys.readouterr().err


@pytest.mark.slow
def test_a_small_object_in_the_middle_of_nowhere_is_found(renderer):
    mi = renderer
    pose = mi.ScalarTransform4f().look_at([0, 0, -20], [0, 0, 0], [0, 1, 0])
    cube = {"type": "cube", "to_world": mi.ScalarTransform4f().rotate([1, 1, 0], 40).scale(0.7)}
    scene = mi.load_dict({"type": "scene", "camera": {"type": "perspective", "fov": 10, "to_world": pose}, "c": cube})
    around, rng = Surroundings(scene), np.random.default_rng(4)
    blind = [what_shows(around, random_view(around, rng, 64, 20, 0.005)) for _ in range(40)]
    assert np.mean(blind) < 0.02, "the walk finds it by itself"
    assert what_shows(around, find_view(around, rng, 64, 20, 0.005)) > 0


def test_a_scene_has_its_parts_in_the_same_order_whenever_it_is_loaded(renderer, tmp_path):
    """Merging of equal parts shuffles them, and with the lamps the light that a random number stands for."""
    path = str(scenes.make_scene((1, 2), tmp_path))
    orders = set()
    for _ in range(6):
        scene = load_scene(path)
        orders.add(tuple(float(x) for shape in scene.shapes() for x in (*shape.bbox().min, *shape.bbox().max)))
    assert len(orders) == 1


def test_views_of_a_scene_share_their_kernels(renderer):
    """Where two factors of the projection were equal to the last bit, everything was compiled once more."""
    import drjit as dr

    mi = renderer
    ball = {"type": "sphere", "center": [0, 0, 5], "to_world": mi.ScalarTransform4f().scale(0.5)}
    scene = mi.load_dict({"type": "scene", "camera": {"type": "thinlens", "aperture_radius": 0.1}, "ball": ball})
    around = Surroundings(scene)
    point = dr.opaque(mi.Point2f, 0.3, 64)

    def kernels(views: list[CameraView]) -> int:
        found = set()
        for view in views:
            view.apply(scene)
            with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
                dr.kernel_history_clear()
                dr.eval(scene.sensors()[0].sample_ray_differential(0.0, 0.5, point, point))
                found |= {kernel["hash"] for kernel in dr.kernel_history([dr.KernelType.JIT])}
        return len(found)

    rng = np.random.default_rng(1)
    views = [random_view(around, rng, 64, 20, 0.005) for _ in range(24)]
    assert kernels([with_one_kernel(around, view) for view in views]) == 1
    # That they would not by themselves: the first pair of factors differs, the second does not.
    view = random_view(around, rng, 64, 20, 0.005)
    sizes = ((351, 198), (187, 123)), ((114, 64), (0, 0))
    assert kernels([replace(view, film=film, window=window, fov=42.0) for film, window in sizes]) == 2


@pytest.mark.slow
def test_tiny(renderer, tmp_path):
    """The real thing, twice: killed on the way and continued, then by a pool of processes; the same bits."""
    command = [sys.executable, "-m", "data_gen", "--config", "configs/data-tiny.toml", "--out"]
    process = subprocess.Popen([*command, str(tmp_path / "a")], cwd=ROOT, start_new_session=True)
    while process.poll() is None and len(list((tmp_path / "a").glob("shards/[!.]*"))) < 2:
        time.sleep(0.1)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    subprocess.run([*command, str(tmp_path / "a")], cwd=ROOT, check=True)
    subprocess.run([*command, str(tmp_path / "b"), "--workers", "2"], cwd=ROOT, check=True)
    data = Dataset(tmp_path / "a")
    assert len(data) == 4 and problems(tmp_path / "a") == problems(tmp_path / "b") == []
    for one, other in zip(data, Dataset(tmp_path / "b"), strict=True):
        np.testing.assert_array_equal(one.reference, other.reference)
        a, b = one.reference_halves
        whole = one.reference - one.reference_direct - one.reference_caustic
        # Independent, and what they have in common is the reference.
        assert 0 < np.abs((a + b) / 2 - whole).mean() < np.abs(a - b).mean()
        for k in range(one.inputs):
            for name in one.stack(k).names:
                np.testing.assert_array_equal(one.stack(k)[name], other.stack(k)[name])
    assert (tmp_path / "a" / "README.md").exists() and (tmp_path / "a" / "contact.png").exists()


@pytest.mark.slow
def test_dask_cluster_with_a_worker_killed(tmp_path, monkeypatch):
    distributed = pytest.importorskip("distributed")
    monkeypatch.setattr(jobs, "make_shard", stand_in)
    config = DatasetConfig(scenes=60, crops=1)
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        pids = [worker.pid for worker in cluster.workers.values()]
        killed = []

        def progress(done, total):
            if done >= 5 and not killed:
                killed.append(os.kill(pids[0], signal.SIGKILL))

        with dask_cluster(cluster.scheduler_address) as executor:
            jobs.generate(config, tmp_path, executor, progress=progress)
    assert killed and len(hashes(tmp_path)) == 60 and problems(tmp_path) == []


def test_a_dead_worker_is_an_error_that_says_how_to_go_on(tmp_path, monkeypatch):
    monkeypatch.setattr(jobs, "make_shard", die)
    with ProcessPoolExecutor(1) as executor, pytest.raises(NgptError, match="continue"):
        jobs.generate(DatasetConfig(scenes=1, crops=1), tmp_path, executor)


def die(config, job, folder, variant):
    os._exit(9)
