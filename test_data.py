"""Tests of the metric, the data and the commands.

Expected values never come from the code under test. They come from an independent source: a
definition written out, a closed form, or another library.
"""
import argparse
import errno
import json
import math
import os
import pickle
import platform
import re
import runpy
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import d3dlo
import kitti
import metrics
from d3dlo import Config, Layer, load_records, scan_records
from kitti import from_vector, invert, to_vector

settings.register_profile(
    "d3dlo", deadline=None, derandomize=True, database=None, max_examples=25,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
settings.load_profile("d3dlo")

# ------------------------------------------------------------------------------------------------
# Helpers

HERE = Path(__file__).resolve().parent
SEED = st.integers(0, 2**32 - 1)
generator = np.random.default_rng

# A network with every kind of layer and a hundredth of the work
SMALL = Config(sa1=Layer(2.0, 32, 4, (4, 8, 16)), fe=Layer(None, None, 6, (16, 32)),
               sa2=Layer(4.0, 16, 8, (32, 32)), sa3=Layer(8.0, 8, 4, (32, 32)),
               mpn=Layer(None, None, None, (32, 64)), mlp=Layer(None, None, None, (32, 6)),
               max_range=50.0, swap="both")

# What a weights file says about its training data. The ranges in `seen` fit any scan.
FACTS = dict(trained_on=[], mean_motion=[10.0, 1, 0, 0, 0, 3],
             seen=[[1.0, 0.1, 1.0, 0.01], [1e6, 1.0, 100.0, 1.0]])

SCAN, POSES, CALIB = "sequences/00/velodyne/000005.bin", "poses/00.txt", "sequences/00/calib.txt"
DRIVE = "2011_09_26/2011_09_26_drive_0013_sync"


def table(arguments, cases):
    """Parametrize by {name of the case: values}."""
    return pytest.mark.parametrize(arguments, cases.values(), ids=cases)


def random_scan(rng, n):
    """A scan (n,4) in a flat box of 16 m."""
    xy, z = rng.uniform(-8, 8, (n, 2)), rng.uniform(-2, 2, n)
    return np.c_[xy, z, rng.random(n)].astype(np.float32)


def random_motion(rng, scale=(0.5, 0.2, 0.1, 0.5, 0.5, 2.0), n=None):
    """One rigid motion (4,4), or n of them (n,4,4); scale in metres and degrees."""
    return from_vector(rng.normal(size=6 if n is None else (n, 6)) * scale)


def random_trajectory(rng, n, scale=(2.5, 0.3, 0.1, 0.3, 0.3, 3.0)):
    """Poses (n,4,4) of a drive forward that keeps turning the same way."""
    steps = np.abs(rng.normal(size=(n - 1, 6))) * scale * [1, *rng.choice([-1, 1], 5)]
    return d3dlo.accumulate(from_vector(steps))


def straight_path(n, step=1.0):
    """Poses (n,4,4) of a camera that moves along z, its viewing direction."""
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, 2, 3] = step * np.arange(n)
    return T


def euler_pose(v):
    """The pose (4,4) of x, y, z [m], roll, pitch, yaw [degrees], written out."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(np.radians(v[3:])), np.sin(np.radians(v[3:]))
    Rx = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    Ry = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    Rz = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rz @ Ry @ Rx, v[:3]
    return T


def save_weights(path, config=SMALL, **facts):
    """Write a weights file as `fit` does, of an untrained network. Returns the path as a text."""
    torch.manual_seed(0)
    net = d3dlo.D3DLO(config)
    net.mlp[-1].weight.data *= 30  # so that the predictions depend visibly on the scans
    d3dlo.save(path, config=config.as_dict(), model=net.state_dict(), step=0, **FACTS | facts)
    return str(path)


def numbers(array):
    return " ".join(map(repr, np.ravel(array).tolist()))


def write_root(root, names=("00",), scans=6, size=60, step=1.0):
    """Random scans in KITTI's layout, for tests where it does not matter what is learned."""
    rng, Tr = generator(0), euler_pose(np.array([0.1, -0.2, 0.3, -90, 0, -90]))
    for name in names:
        folder = Path(root, "sequences", name)
        (folder / "velodyne").mkdir(parents=True)
        for i in range(scans):
            random_scan(rng, size).tofile(folder / "velodyne" / f"{i:06d}.bin")
        (folder / "calib.txt").write_text(f"P0: 1 0 0 0 0 1 0 0 0 0 1 0\nTr: {numbers(Tr[:3])}\n")
        T = random_trajectory(rng, scans, (step, 0.1, 0.1, 0.3, 0.3, 1))
        metrics.write_poses(Path(root, "poses", f"{name}.txt"), T)
    return Path(root)


def save_bin(path, scan):
    scan.tofile(path)


def write_folder(folder, scans=12, save=np.save, name="scan {}.npy", scale=1, columns=4):
    """Write a plain folder of random scans, numbered from 1. Returns the scans."""
    rng = generator(0)
    Path(folder).mkdir()
    made = [(random_scan(rng, 50) * np.float32([1, 1, 1, scale]))[:, :columns]
            for _ in range(scans)]
    for i, scan in enumerate(made, 1):
        save(Path(folder, name.format(i)), scan)
    return made


# Functions that spoil good data. Each returns a function of the folder that holds the data.


def rewrite(name, change):
    """Apply `change` to the bytes of a file."""
    return lambda root: (root / name).write_bytes(change((root / name).read_bytes()))


def delete(pattern, numbers=(0,)):
    """Delete the files of these numbers."""
    return lambda root: [(root / pattern.format(i)).unlink() for i in numbers]


def blank_lines(name, numbers):
    """Empty these lines of a file."""
    return rewrite(name, lambda text: b"\n".join(b"" if i in numbers else line for i, line
                                                 in enumerate(text.splitlines())))


def save_as(name, array):
    return lambda root: np.save(root / name, array, allow_pickle=True)


def drop_last_word(data):
    return data.rstrip().rpartition(b" ")[0]


def change_in_the_middle(path):
    """Change a scan but keep the file's size and modification time, as `rsync -t` may do."""
    data, stat = bytearray(path.read_bytes()), path.stat()
    data[len(data) // 32 * 16 + 3] ^= 128  # flips the sign of an x
    path.write_bytes(data)
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))


class Mischief:
    """Makes a folder when it is unpickled, as a malicious file might run code."""

    def __reduce__(self):
        return os.mkdir, ("mischief",)


# Commands, which run in this process


@pytest.fixture
def cwd(tmp_path, monkeypatch):
    """An empty current folder, for runs, results and caches."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="session")
def weights(tmp_path_factory):
    return save_weights(tmp_path_factory.mktemp("weights") / "w.pt")


def run(command):
    """Run a command such as "eval --data root", "raw DRIVE ROOT" or "metrics GT EST"."""
    first, *rest = words = command.split()
    if first == "metrics":
        return metrics.main(rest)
    return (kitti if first in ("simulate", "raw") else d3dlo).main(words)


def error_lines(err):
    """The lines of stderr that do not show progress."""
    lines = [line.strip() for line in err.splitlines() if line.strip()]
    return [line for line in lines if not re.search(r": \d+/\d+, .* left$", line)]


def files_of(root):
    """{path: content} of everything below a folder but the cache; None for folders."""
    paths = [path for path in Path(root).rglob("*") if "cache" not in path.parts]
    return {str(path.relative_to(root)): path.read_bytes() if path.is_file() else None
            for path in paths}


def refused(command, pattern, capsys):
    """Assert that a command fails with one line on stderr, which matches, and writes nothing."""
    capsys.readouterr()
    before = files_of(".")
    code = run(command)
    out, err = capsys.readouterr()
    lines = error_lines(err)
    assert code == 2 and len(lines) == 1 and re.search(pattern, lines[0]), err
    assert "Traceback" not in err + out and files_of(".") == before


def results_of(folder):
    return json.loads(Path(folder, "results.json").read_text())


def stored(folder, name="weights.pt"):
    return torch.load(Path(folder, name), weights_only=True)


def same_bits(a, b):
    """Whether two files hold the same tensors and numbers."""
    if isinstance(a, torch.Tensor):
        return torch.equal(a, b)
    if isinstance(a, (dict, list, tuple)):
        keys = a if isinstance(a, dict) else range(len(a))
        return len(a) == len(b) and all(same_bits(a[key], b[key]) for key in keys)
    return a == b


def table_row(out, name):
    """The figures in a row of a printed table, without the star of sequences trained on."""
    return re.search(rf"^{name}(?: \*)? +(\S.*)$", out, re.M)[1].split()


def as_printed(s):
    """The numbers of a sequence or group in results.json, as a row of the printed table."""
    formats = {"segments": "d", "E_t": ".3f", "E_r": ".5f", "t_step_m": ".4f", "r_step_deg": ".4f"}
    return ["-" if s[key] is None else format(s[key], f) for key, f in formats.items()]


# ------------------------------------------------------------------------------------------------
# The metric


def devkit_errors(T_gt, T_est):
    """Segment errors as KITTI's development kit computes them, loop by loop.

    Its functions are trajectoryDistances, lastFrameFromSegmentLength and calcSequenceErrors.
    Returns rows of first frame, last frame, length [m], E_t [%] and E_r [degrees/m].
    """
    dist = [0.0]
    for a, b in zip(T_gt, T_gt[1:]):
        dx, dy, dz = a[:3, 3] - b[:3, 3]
        dist.append(dist[-1] + math.sqrt(dx * dx + dy * dy + dz * dz))
    errors = []
    for first in range(0, len(T_gt), 10):
        for length in (100, 200, 300, 400, 500, 600, 700, 800):
            last = -1
            for i in range(first, len(T_gt)):
                if dist[i] > dist[first] + length:
                    last = i
                    break
            if last == -1:
                continue
            delta_gt = np.linalg.inv(T_gt[first]) @ T_gt[last]
            delta_est = np.linalg.inv(T_est[first]) @ T_est[last]
            error = np.linalg.inv(delta_est) @ delta_gt
            d = 0.5 * (error[0, 0] + error[1, 1] + error[2, 2] - 1.0)
            r = math.acos(max(min(d, 1.0), -1.0))
            t = math.sqrt(error[0, 3] ** 2 + error[1, 3] ** 2 + error[2, 3] ** 2)
            errors.append((first, last, length, 100 * t / length, math.degrees(r) / length))
    return np.array(errors).reshape(-1, 5)


@table("drive", {"winding": random_trajectory,
                 "straight": lambda rng, n: straight_path(n, 2.5)})  # 100 m are exactly 40 frames
@given(seed=SEED, n=st.integers(2, 450), size=st.sampled_from([0, 1e-5, 0.02, 20]))
def test_segment_errors_equal_the_devkits_and_step_errors_are_those_added(drive, seed, n, size):
    rng = generator(seed)
    T_gt = drive(rng, n)
    E = random_motion(rng, size, len(T_gt) - 1)
    start = random_motion(rng, [50, 50, 50, 90, 60, 90])  # must not affect the errors
    T_est = start @ d3dlo.accumulate(np.linalg.inv(T_gt[:-1]) @ T_gt[1:] @ E)

    expected, got = devkit_errors(T_gt, T_est), metrics.segment_errors(T_gt, T_est)
    fields = {"first": 0, "last": 0, "length": 0, "t_err": 1e-7, "r_err": 1e-6}
    for (field, tolerance), column in zip(fields.items(), expected.T, strict=True):
        assert_allclose(got[field], column, rtol=tolerance, atol=tolerance)

    t = np.linalg.norm(E[:, :3, 3], axis=1)
    r = np.degrees(Rotation.from_matrix(E[:, :3, :3]).magnitude())
    assert_allclose(metrics.step_errors(T_gt, T_est), np.stack([t, r], 1), atol=1e-9)


def test_kitti_errors_are_means_over_the_segments_of_all_sequences():
    rng = generator(0)
    pairs = [(random_trajectory(rng, n), random_trajectory(rng, n)) for n in (450, 90, 5)]
    expected = np.concatenate([devkit_errors(*pair) for pair in pairs])[:, 3:].mean(0)
    got = metrics.kitti_errors([metrics.segment_errors(*pair) for pair in pairs])
    assert_allclose(got, expected)
    assert np.isnan(metrics.kitti_errors([])).all()
    assert np.isnan(metrics.kitti_errors([metrics.segment_errors(*pairs[2])])).all()


@pytest.mark.parametrize(
    "error", [metrics.segment_errors, metrics.step_errors, metrics.absolute_error])
def test_trajectories_of_different_shapes_are_refused(error):
    with pytest.raises(ValueError, match="20.*19"):
        error(straight_path(20), straight_path(19))
    with pytest.raises(ValueError, match="4, 4.*3, 4"):
        error(straight_path(20), straight_path(20)[:, :3])


@given(SEED)
def test_the_absolute_error_is_the_root_mean_square_of_the_distances(seed):
    rng = generator(seed)
    T = random_trajectory(rng, 20)
    apart, moved = rng.normal(size=(20, 3)) * [1, 2, 4], T.copy()
    moved[:, :3, 3] += apart
    squares = [x * x + y * y + z * z for x, y, z in apart]
    assert metrics.absolute_error(T, moved) == pytest.approx(math.sqrt(sum(squares) / 20))
    assert metrics.rmse([3.0, 4.0]) == pytest.approx(math.sqrt(12.5))
    assert math.isnan(metrics.rmse([]))


@given(SEED, st.integers(1, 30))
def test_pose_files_survive_the_round_trip_also_with_a_byte_order_mark(tmp_path, seed, n):
    T, path = random_trajectory(generator(seed), n), tmp_path / "new" / "a.txt"
    metrics.write_poses(path, T)
    assert os.listdir(path.parent) == ["a.txt"] and np.loadtxt(path, ndmin=2).shape == (n, 12)
    text = path.read_text()
    for encoding in ("utf-8", "utf-8-sig"):
        path.write_text(text, encoding=encoding)
        assert_allclose(metrics.read_poses(path), T, rtol=1e-8, atol=1e-8)
    path.write_text(text, encoding="utf-16")
    with pytest.raises(ValueError, match="a.txt.*UTF-16"):
        metrics.read_poses(path)


@given(SEED, st.sampled_from([0, 1e-9, 1e-4, 1, 179.9999, 180]))
def test_tum_files_hold_times_positions_and_unit_quaternions(tmp_path, seed, degrees):
    rng = generator(seed)
    axes = np.r_[rng.normal(size=(4, 3)), np.eye(3), -np.eye(3)]  # random axes and x, y, z
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    T = random_motion(rng, n=len(axes))
    T[:, :3, :3] = Rotation.from_rotvec(np.radians(degrees) * axes).as_matrix()
    times = 1.3e9 + np.cumsum(rng.uniform(0.05, 0.2, len(T)))  # seconds since 1970
    kitti.write_tum(tmp_path / "a.tum", T, times)
    rows = np.loadtxt(tmp_path / "a.tum")
    assert rows.shape == (len(T), 8)
    assert_allclose(rows[:, 0], times, rtol=0, atol=1e-6)
    assert_allclose(rows[:, 1:4], T[:, :3, 3], atol=1e-8)
    assert_allclose(np.linalg.norm(rows[:, 4:], axis=1), 1, atol=1e-8)
    assert_allclose(Rotation.from_quat(rows[:, 4:]).as_matrix(), T[:, :3, :3], atol=1e-8)
    assert (rows[:, 7] >= 0).all()
    with pytest.raises(ValueError):
        kitti.write_tum(tmp_path / "b.tum", T, times[:-1])
    assert os.listdir(tmp_path) == ["a.tum"]


@given(SEED, st.sampled_from([-1, 1]))
def test_the_view_from_above_is_the_same_for_camera_and_lidar_poses(seed, gear):
    rng = generator(seed)
    signs = [gear, *rng.choice([-1, 1], 5)]  # forwards or in reverse
    steps = np.abs(rng.normal(size=(50, 6))) * [1, 0.05, 0.05, 1, 1, 6] * signs
    lidar = d3dlo.accumulate(from_vector(steps))
    # Camera and LiDAR at the same place
    Tr = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    for T, labels in ((lidar, ["LiDAR -y, right [m]", "LiDAR x, forward [m]"]),
                      (Tr @ lidar @ Tr.T, ["camera x, right [m]", "camera z, forward [m]"])):
        view, *axes = metrics.view_from_above(T)
        assert axes == labels
        assert_allclose(view @ T[:, :3, 3].T, [-lidar[:, 1, 3], lidar[:, 0, 3]], atol=1e-9)


def test_metrics_on_the_command_line(cwd, capsys):
    gt, est = straight_path(300), straight_path(300, 1.01)
    files = {"gt/03": gt, "gt/07": gt[:200], "est/03": est, "est/07": gt[:200], "short": gt[:20]}
    for name, T in files.items():
        metrics.write_poses(f"{name}.txt", T)
    assert run("metrics short.txt short.txt") == 0
    assert table_row(capsys.readouterr().out, "short")[:4] == ["0", "-", "-", "0.0000"]

    assert run("metrics gt/03.txt est/03.txt") == 0
    expected, out = devkit_errors(gt, est)[:, 3], capsys.readouterr().out
    ate = math.sqrt(sum((0.01 * i) ** 2 for i in range(300)) / 300)
    assert table_row(out, "03") == [str(len(expected)), f"{expected.mean():.3f}", "0.00000",
                                    "0.0100", "0.0000", f"{ate:.3f}", "0.0100", "0.0000"]
    assert table_row(out, "100 m")[1] == "1.010" and table_row(out, "200 m")[1] == "1.005"

    assert run("metrics gt est") == 0
    pooled = np.r_[expected, devkit_errors(gt[:200], gt[:200])[:, 3]]
    assert table_row(capsys.readouterr().out, "all")[1] == f"{pooled.mean():.3f}"


def test_pictures_are_drawn_if_matplotlib_is_installed_and_never_replace_an_input(
        cwd, weights, monkeypatch, capsys):
    write_root("root")
    for name in ("gt/a.txt", "est/a.txt", "gt.png"):
        metrics.write_poses(name, straight_path(120))
    for plot in ("gt/a.txt", "est/../est/a.txt", "new.jpg", "gt.png"):
        for pair in ("gt.png est/a.txt", "gt est" if plot != "gt.png" else "gt.png gt.png"):
            refused(f"metrics {pair} --plot {plot}", "--plot.*png", capsys)
    with monkeypatch.context() as patch:  # as if matplotlib were not installed
        patch.setitem(sys.modules, "matplotlib.figure", None)
        refused("metrics gt est --plot new.png", "matplotlib.*pip install", capsys)
        refused(f"eval --data root --weights {weights} --plot", "matplotlib.*pip install", capsys)
        assert not Path("cache").exists()  # refused before the work

    pytest.importorskip("matplotlib")
    for name, start in {"a.png": b"\x89PNG", "b.pdf": b"%PDF", "c.svg": b"<?xml"}.items():
        assert run(f"metrics gt est --plot {name}") == 0
        assert Path(name).read_bytes().startswith(start)
    assert run(f"eval --data root --weights {weights} --out out --plot") == 0
    assert Path("out/plot.png").read_bytes().startswith(b"\x89PNG")


# ------------------------------------------------------------------------------------------------
# The data


@given(SEED, st.floats(-8, 8), st.floats(-8, 8))
def test_remove_plane_removes_points_within_15_cm_of_the_ground_and_keeps_the_order(
        seed, roll, pitch):
    rng = generator(seed)
    heights = np.r_[rng.normal(0, 0.02, 3000), rng.choice([-0.12, 0.12], 50),
                    rng.choice([-0.18, 0.18], 50), rng.uniform(0.4, 3, 1500)]
    points = np.c_[rng.uniform(-20, 20, (4600, 2)), heights, np.ones(4600)]
    tilted = euler_pose(np.array([0, 0, -1.7, roll, pitch, 0]))
    scan = np.c_[(points @ tilted.T)[:, :3], rng.random(4600)]
    order = rng.permutation(4602)
    scan = np.r_[scan, np.full((2, 4), np.nan)].astype(np.float32)[order]
    assert_array_equal(kitti.remove_plane(scan, seed=seed), scan[order >= 3050])


@pytest.mark.parametrize("N, thick", [(0, 0), (2, 0), (500, 0), (5000, 0.1)])
def test_remove_plane_without_a_ground_plane_changes_nothing(N, thick):
    rng = generator(0)
    wall = np.c_[rng.normal(size=N) * thick, rng.uniform(-9, 9, N), rng.uniform(-2, 9, N),
                 rng.random(N)].astype(np.float32)
    assert_array_equal(kitti.remove_plane(wall), wall)


def test_invalid_points_are_counted_and_far_points_and_the_ground_are_dropped():
    rng = generator(0)
    ground = np.c_[rng.uniform(-20, 20, (3000, 2)), np.full(3000, -1.7), rng.random(3000)]
    near = random_scan(rng, 50) + [0, 0, 3, 0]
    far = np.array([[60, 0, 9, 0.5], [30, -40.1, 9, 0.5]])
    bad = np.array([[np.nan, 0, 0, 0], [0, 0, 0, np.inf], [0, 0, 0, 1e6], [0, 900, 500, 0.5],
                    [1e30, 0, 0, 0]])
    scan = np.r_[near, bad, far, ground].astype(np.float32)
    for max_range, plane, kept in ((50, False, [near]), (50, True, [near, ground]),
                                   (None, False, [near, far]), (None, True, [near, far, ground])):
        points, invalid = kitti.usable_points(scan, max_range, plane)
        assert invalid == 5
        assert_array_equal(points, np.concatenate(kept).astype(np.float32))
    for shape in ((5, 3), (4,)):
        with pytest.raises(ValueError, match="shape"):
            kitti.usable_points(np.zeros(shape))


@table("save, name", {"bin": (save_bin, "{}.pcd.bin"), "npy": (np.save, "scan-{}-of-12.npy")})
def test_a_folder_of_scans_is_one_sequence_in_natural_order(tmp_path, save, name):
    folder = tmp_path / "drive"
    scans = write_folder(folder, save=save, name=name)
    (folder / "._1.bin").write_text("left by another system")
    (folder / "notes.txt").write_text("not a scan")
    s, = kitti.open_sequences(folder)
    assert kitti.sequence_names(folder) == [s.name] == ["drive"] and len(s) == 12
    for i, scan in enumerate(scans):  # 2 comes before 10
        assert s.scan(i).dtype == np.float32
        assert_array_equal(s.scan(i), scan)
    assert s.Tr is None and s.poses is None and s.poses_cam is None
    assert_allclose(s.times, np.arange(12) / 10)
    assert len(s.notes) == 1 and "10 scans a second" in s.notes[0]
    times = 1.3e9 + np.arange(12) * 0.25
    np.savetxt(folder / "times.txt", times, fmt="%.6f")
    s, = kitti.open_sequences(folder)
    assert_allclose(s.times, times, rtol=0, atol=1e-6)
    assert s.notes == []


@pytest.mark.parametrize("name, removed, note", [
    ("{:06d}.npy", (4, 5, 9), "3 scans are missing, the first after 000003.npy"),
    ("{}00000.npy", (4, 5, 9), ""), ("scan {}.npy", (4, 5, 9), ""),  # times and other names
    ("{:06d}.npy", (1, 2, 12), ""), ("{:06d}.npy", range(2, 12, 2), "")])  # cut, every second scan
def test_missing_scans_of_a_numbered_folder_are_noted(tmp_path, name, removed, note):
    write_folder(tmp_path / "drive", name=name)
    delete(name, removed)(tmp_path / "drive")
    s, = kitti.open_sequences(tmp_path / "drive")
    notes = [text for text in s.notes if "missing" in text]
    assert len(notes) == bool(note) and note in "".join(notes)


@pytest.mark.parametrize("scale, columns, divisor, words", [
    (0.9, 4, 1, ""), (255, 4, 255, "255"), (2, 4, 255, "255"),
    (1, 3, 1, "no intensities"), (0, 4, 1, "no intensities")])
def test_intensities_of_a_folder_are_scaled_to_0_to_1(tmp_path, scale, columns, divisor, words):
    scans = write_folder(tmp_path / "drive", scale=scale, columns=columns)
    (tmp_path / "drive" / "times.txt").write_text("\n".join(map(str, range(12))))
    s, = kitti.open_sequences(tmp_path / "drive")
    for i, scan in enumerate(scans):
        intensity = scan[:, 3] / np.float32(divisor) if columns == 4 else np.zeros(50)
        assert_array_equal(s.scan(i), np.c_[scan[:, :3], intensity])
    assert len(s.notes) == bool(words) and words in "".join(s.notes)


def test_the_cache_equals_scan_records_and_is_computed_again_when_anything_changes(cwd, capsys):
    root = write_root("root", ("00", "drive"))

    def load(config=SMALL):
        """Check the records. Returns their file names and times."""
        sequences = kitti.open_sequences(root)
        for s, records in zip(sequences, load_records(sequences, config), strict=True):
            expected = np.concatenate([scan_records(s.scan(i), config) for i in range(len(s))])
            expected["crc"] = records["crc"]  # tested by the fingerprints
            assert records.tobytes() == expected.tobytes()
        return {path: path.stat().st_mtime_ns for path in Path("cache").iterdir()}

    first = load()
    assert len(first) == 2 and load() == first  # the second time nothing is computed
    change_in_the_middle(root / "sequences/drive/velodyne/000002.bin")
    assert len(load()) == 3  # only the sequence that changed
    changes = [dict(sa1=Layer(1.0, *SMALL.sa1[1:])), dict(sa1=Layer(2.0, 32, 5, (4, 8, 16))),
               dict(sa2=Layer(4.0, 12, 8, (32, 32))), dict(sa2=Layer(3.0, *SMALL.sa2[1:])),
               dict(sa3=Layer(7.0, *SMALL.sa3[1:])), dict(plane=False), dict(max_range=9.0)]
    for i, change in enumerate(changes):
        assert len(load(replace(SMALL, **change))) == 5 + 2 * i
    assert len(load(replace(SMALL, fe=Layer(None, None, 3, (16, 32)), lr=5.0))) == 17  # unrelated

    # A damaged file is computed again
    capsys.readouterr()
    path = max(first, key=str)
    good = path.read_bytes()
    for bad in (good[:-1], good[:200], b"", b"noise" * 40, pickle.dumps(Mischief())):
        path.write_bytes(bad)
        load_records(kitti.open_sequences(root), SMALL)
        assert "damaged" in capsys.readouterr().err and not Path("mischief").exists()


def during(monkeypatch, module, name, action):
    """Let `action` happen once, in the middle of what is going on: before module.name is called."""
    original = getattr(module, name)

    def replacement(*arguments, **options):
        monkeypatch.setattr(module, name, original)
        action()
        return original(*arguments, **options)

    monkeypatch.setattr(module, name, replacement)


def test_two_processes_can_share_a_cache(cwd, monkeypatch):
    sequences, other = kitti.open_sequences(write_root("root")), []
    during(monkeypatch, kitti, "replacing", lambda: other.append(load_records(sequences, SMALL)))
    records, = load_records(sequences, SMALL)
    assert records.tobytes() == other[0][0].tobytes() and len(os.listdir("cache")) == 1


IDENTITY = b"1 0 0 0 0 1 0 0 0 0 1 0\n"


def test_a_fingerprint_depends_on_the_scans_and_poses_and_not_on_names_or_times(cwd):
    def fingerprint(root):
        s, = kitti.open_sequences(root)
        return s.fingerprint(load_records([s], SMALL)[0]["crc"])

    write_root("root")
    for name, change in {
            "names": lambda root: [path.rename(str(path).replace("00.txt", "drive.txt").replace(
                "/00", "/drive")) for path in (root / POSES, root / "sequences/00")],
            "times": lambda root: os.utime(root / SCAN, (1, 1)),
            "a scan": lambda root: change_in_the_middle(root / SCAN),
            "its length": rewrite(SCAN, lambda data: data + data[:16]),
            "a pose": rewrite(POSES, lambda data: data.partition(b"\n")[2] + IDENTITY),
            "the order": lambda root: [(root / SCAN).rename(root / "x"),
                                       (root / SCAN.replace("5", "4")).rename(root / SCAN),
                                       (root / "x").rename(root / SCAN.replace("5", "4"))]}.items():
        change(shutil.copytree("root", cwd / name))
        assert (fingerprint(name) == fingerprint("root")) == (name in ("names", "times")), name


# ------------------------------------------------------------------------------------------------
# The simulated city


def test_the_city_is_the_same_with_any_workers_and_existing_sequences_are_kept(cwd, capsys):
    def simulate(to, names, **more):
        return files_of(kitti.simulate(to, sequences=names, scans=9, azimuth=200, **more))

    made = simulate("one", ("00", "07"), workers=1)
    assert simulate("two", ("07", "00"), workers=2) == made
    for name, data in simulate("other", ("07",), seed=1).items():
        if name.endswith((".bin", "07.txt")):
            assert data != made[name]
    Path("two", SCAN).write_bytes(b"there")
    assert simulate("two", ("00", "07"))[SCAN] == b"there"

    # Sequences with other settings, of another version, or of real data are never overwritten
    arguments = "simulate one --sequences 07 --scans 9 --azimuth 200 "
    assert run(arguments) == 0 and "9 scans" in capsys.readouterr().out
    for change, words in {"--azimuth 100": "07.*another folder", "--seed 1": "07.*another folder",
                          "--scans 2": "07.*another folder", "--azimuth 3": "azimuth.*16 or more",
                          "--scans 0": "scans.*must", "--sequences ../x": "../x.*use"}.items():
        refused(arguments + change, words, capsys)
    rewrite("one/sequences/07/simulated.json", lambda text: re.sub(rb"\d", b"1", text, 1))(cwd)
    refused(arguments, "version.*delete or rename", capsys)
    write_root("real")
    refused("simulate real --sequences 00 --scans 2", "00.*another folder", capsys)


def test_simulated_scans_are_in_kittis_layout_and_fit_their_poses(tmp_path):
    root = kitti.simulate(tmp_path, sequences=("02",), scans=3, azimuth=900, workers=1)
    s, = kitti.open_sequences(root)
    assert len(s) == len(s.poses) == 3
    assert_allclose(s.poses[0], np.eye(4), atol=1e-8)
    # Tr is far from the identity, so that confused frames would be noticed
    assert np.abs(s.Tr[:3, :3] - np.eye(3)).max() > 0.9 and np.abs(s.Tr[:3, 3]).max() > 0.1
    for i in range(3):
        scan = s.scan(i)
        distances = np.linalg.norm(scan[:, :3], axis=1)
        assert len(scan) > 15000 and 1 < distances.min() and distances.max() < 80.5
        assert 0 <= scan[:, 3].min() and scan[:, 3].max() <= 1
    for i, T in enumerate(s.motions()):
        p, q = s.scan(i)[:, :3], s.scan(i + 1)[:, :3]
        q = q[q[:, 2] > -1.2]  # without the ground, which fits every motion along it
        tree = cKDTree(p)

        def distance(M, q=q, tree=tree):
            return np.median(tree.query(q @ M[:3, :3].T + M[:3, 3])[0])

        wrong = np.eye(4), invert(T), kitti.velo_to_camera(T, s.Tr)
        assert distance(T) < 0.1 and min(map(distance, wrong)) > 3 * distance(T)


def test_simulated_test_sequences_are_long_and_winding_enough_to_be_evaluated(tmp_path):
    errors, steps = [], []
    root = kitti.simulate(tmp_path, sequences=["test"], azimuth=16, workers=1)
    for s in kitti.open_sequences(root):
        steps.append(to_vector(s.motions()))
        without_rotation = d3dlo.accumulate(from_vector(steps[-1] * [1, 1, 1, 0, 0, 0]))
        errors.append(metrics.segment_errors(s.poses, without_rotation))
        assert metrics.path_lengths(s.poses)[-1] > 115 and len(errors[-1])
    steps = np.concatenate(steps)
    # The true translation without any rotation must not score well
    assert metrics.kitti_errors(errors)[0] > 40
    metres, degrees = np.linalg.norm(steps[:, :3], axis=1), np.abs(steps[:, 5])
    assert degrees.std() > 0.9 and 0.8 < metres.mean() < 1.2
    # A motorway, ramps and roundabouts, and a halt
    assert metres.max() > 2.5 and np.mean(metres > 1.5) > 0.05
    assert np.mean((metres > 0.8) & (2 < degrees) & (degrees < 3.5)) > 0.05
    assert np.mean(metres < 0.01) > 0.01


def footprints(prisms, n=15):
    """Points x, y (m,n,n) that cover m prisms (m,10) in plan."""
    u = np.linspace(-1, 1, n)
    x, y, yaw, half_x, half_y = prisms[:, :5].T[:, :, None, None]
    along, across = half_x * u[:, None], half_y * u
    return (x + along * np.cos(yaw) - across * np.sin(yaw),
            y + along * np.sin(yaw) + across * np.cos(yaw))


@pytest.mark.parametrize("name", ["01", "05", "06"])
def test_simulated_vehicles_drive_with_us_on_a_free_road_and_never_into_us(name):
    scans = 170
    world = kitti._world(name, 0, scans)
    height, _, corner = world.ground

    def on_road(x, y):
        i, j = (((xy - origin) / kitti.CELL).astype(int) for xy, origin in zip((x, y), corner))
        i, j = i.clip(0, height.shape[0] - 1), j.clip(0, height.shape[1] - 1)
        return height[i, j] == 0

    low = world.prisms[world.prisms[:, kitti.Z0] < 2]
    assert len(low) > 200 and on_road(*world.T_flat[:, :2, 3].T).all()
    assert on_road(*footprints(low)).mean() < 1e-4
    near, with_us, towards_us = [], 0, 0  # vehicles of a scan, and sums of all scans
    for i in range(scans):
        bodies, cabins = np.split(world.moving(i), 2)
        assert len(bodies) == len(cabins) and on_road(bodies[:, 0], bodies[:, 1]).mean() > 0.9
        T = world.T_flat[i]
        yaw = np.arctan2(T[1, 0], T[0, 0])
        x, y = footprints(np.concatenate([bodies, cabins]))
        x, y = x - T[0, 3], y - T[1, 3]
        ahead, left = x * np.cos(yaw) + y * np.sin(yaw), y * np.cos(yaw) - x * np.sin(yaw)
        assert not ((np.abs(ahead) < 2.4) & (np.abs(left) < 0.9)).any()  # our own car
        close = np.hypot(bodies[:, 0] - T[0, 3], bodies[:, 1] - T[1, 3]) < 30
        cosine = np.cos(bodies[close, 2] - yaw)
        near.append(close.sum())
        with_us += np.sum(cosine > 0.7)
        towards_us += np.sum(cosine < -0.7)
    assert np.mean(near) > 2 and with_us > scans and towards_us > 0.3 * scans
