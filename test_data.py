"""Tests of the metric, the data and the commands. Expected values never come from the code under
test: they come from a definition written out, a closed form, or another library.
"""
import argparse
import errno
import io
import json
import math
import os
import pickle
import re
import runpy
import shlex
import shutil
import signal
import subprocess
import sys
import time
import zlib
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
from d3dlo import SHORT, Config, Layer, load_records, relative_pose, scan_records
from kitti import SPLITS, from_vector, invert, to_vector

settings.register_profile(
    "d3dlo", deadline=None, derandomize=True, database=None, max_examples=25,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
settings.load_profile("d3dlo")
torch.set_num_threads(1)  # the networks here are tiny

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
MEAN_MOTION = [10.0, 1, 0, 0, 0, 3]
SEEN = [[1.0, 0.1, 1.0, 0.01], [1e6, 1.0, 100.0, 1.0]]  # fits any scan

EVAL = "eval --data root --weights w.pt --out out"
TRAIN = "train --data root --weights w.pt --epochs 1 --out new"
SCANS, POSES, CALIB = (f"root/{name}" for name in (
    "sequences/00/velodyne", "poses/00.txt", "sequences/00/calib.txt"))
DATE, DRIVE = "2011_09_26", "2011_09_26/2011_09_26_drive_0013_sync"
SCAN_TIMES, PACKET_TIMES, RAW_SCAN, PACKET = (f"{DRIVE}/{name}" for name in (
    "velodyne_points/timestamps.txt", "oxts/timestamps.txt",
    "velodyne_points/data/{:010d}.bin", "oxts/data/{:010d}.txt"))


def table(arguments, cases):
    """Parametrize by {name of the case: values}."""
    return pytest.mark.parametrize(arguments, cases.values(), ids=cases)


def random_scan(rng, n):
    """A scan (n,4) in a flat box of 16 m."""
    xy, z = rng.uniform(-8, 8, (n, 2)), rng.uniform(-2, 2, n)
    return np.c_[xy, z, rng.random(n)].astype(np.float32)


def random_trajectory(rng, n, scale=(2.5, 0.3, 0.1, 0.3, 0.3, 3.0)):
    """Poses (n,4,4) of a drive forward that keeps turning the same way."""
    steps = np.abs(rng.normal(size=(n - 1, 6))) * scale * [1, *rng.choice([-1, 1], 5)]
    return d3dlo.accumulate(from_vector(steps))


def straight_path(n, step=1.0):
    """Poses (n,4,4) of a camera that moves along z, its viewing direction."""
    return d3dlo.accumulate([from_vector([0, 0, step, 0, 0, 0])] * (n - 1))


def numbers(array):
    return " ".join(map(repr, np.ravel(array).tolist()))


def write_root(root, names, seed=0):
    """Sequences of 15 random scans in KITTI's layout, about 11 m apart."""
    rng, Tr = generator(seed), from_vector([0.1, -0.2, 0.3, -90, 0, -90])
    for name in names:
        folder = Path(root, "sequences", name)
        (folder / "velodyne").mkdir(parents=True)
        for i in range(15):
            random_scan(rng, 60).tofile(folder / "velodyne" / f"{i:06d}.bin")
        (folder / "calib.txt").write_text(f"P0: 1 0 0 0 0 1 0 0 0 0 1 0\nTr: {numbers(Tr[:3])}\n")
        T = random_trajectory(rng, 15, (14, 0.1, 0.1, 0.3, 0.3, 1))
        metrics.write_poses(Path(root, "poses", f"{name}.txt"), T)


def write_folder(name="drive/scan {}.npy", scale=1, columns=4):
    """Write a plain folder of 12 random scans, numbered from 1. Returns {path: scan}."""
    scans = {}
    Path(name).parent.mkdir()
    for i in range(1, 13):
        scan = (random_scan(generator(i), 50) * np.float32([1, 1, 1, scale]))[:, :columns]
        scans[path := Path(name.format(i))] = scan
        scan.tofile(path) if path.suffix == ".bin" else np.save(path, scan)
    return scans


def imu_pose(t):
    """T_wi (4,4) of the vehicle of `write_raw` after t seconds: 12 m/s on a climbing bend."""
    yaw = 0.4 + 0.3 * t  # on a circle of 40 m; x is east, y north, z up
    position = [40 * np.sin(yaw), -40 * np.cos(yaw), 100 + 0.5 * t]
    return from_vector([*position, *np.degrees([0.03, 0.05, yaw])])


def write_raw():
    """Write a raw drive of 12 scans. Returns the true poses of the rectified camera, and Tr."""
    rng = generator(0)
    scan_times = 0.1 * np.arange(12) + rng.uniform(-0.004, 0.004, 12)
    packet_times = scan_times + 0.015 + rng.uniform(-0.01, 0.01, 12)
    for file, times in ((SCAN_TIMES, scan_times), (PACKET_TIMES, packet_times)):
        Path(file).with_name("data").mkdir(parents=True)
        # The drive goes on past midnight
        stamps = np.datetime64("2011-09-26T23:59:59.5", "ns") + (1e9 * times).astype(int)
        Path(file).write_text("\n".join(map(str, stamps)).replace("T", " "))
    for i, t in enumerate(packet_times):
        random_scan(rng, 40).tofile(RAW_SCAN.format(i))
        T, yaw = imu_pose(t), 0.4 + 0.3 * t
        east, north, up = T[:3, 3] - imu_pose(packet_times[0])[:3, 3]
        lat, lon = np.degrees([north, east / np.cos(np.radians(49))]) / 6378137  # within 0.1 mm
        packet = np.full(30, 77.0)  # the value of all fields that are not used
        packet[:6] = 49 + lat, 8.4 + lon, up, 0.03, 0.05, yaw
        packet[[6, 7, 10]] = 12 * np.sin(yaw), 12 * np.cos(yaw), 0.5  # to the north, east and up
        packet[17:20] = T[:3, :3].T @ [0, 0, 0.3]  # along the vehicle's axes
        Path(PACKET.format(i)).write_text(numbers(packet))
    velo_imu, cam_velo, rectify = from_vector(
        [[0.8, -0.3, 0.5, 2, 5, 1], [0, -0.1, -0.3, -90, 1, -91], [0, 0, 0, 1, 2, 3]])
    for name, R, T in (("imu_to_velo", "R", velo_imu), ("velo_to_cam", "R", cam_velo),
                       ("cam_to_cam", "R_rect_00", rectify)):
        Path(DATE, f"calib_{name}.txt").write_text(
            f"calib_time: 25-May-2012\n{R}: {numbers(T[:3, :3])}\nT: {numbers(T[:3, 3])}\n")
    poses = [imu_pose(t) @ invert(rectify @ cam_velo @ velo_imu) for t in scan_times]
    return invert(poses[0]) @ poses, rectify @ cam_velo


@pytest.fixture(scope="session")
def original(tmp_path_factory):
    """A folder with data of all kinds, small weights and a training run. Read only."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder := tmp_path_factory.mktemp("original"))
        write_root("root", ("00", "03"))
        write_folder()
        write_raw()
        Path("clouds").mkdir()
        Path("clouds/0.pcd").touch()
        kitti.simulate("city", sequences=["07"], scans=2, azimuth=100)
        torch.manual_seed(0)
        net = d3dlo.D3DLO(SMALL)
        net.mlp[-1].weight.data *= 30  # so that the predictions depend visibly on the scans
        d3dlo.save("w.pt", config=SMALL.as_dict(), model=net.state_dict(), step=0, trained_on=[],
                   mean_motion=MEAN_MOTION, seen=SEEN)
        assert run("train --data root --weights w.pt --epochs 1 --out run") == 0
        shutil.rmtree("cache")
        return folder


@pytest.fixture
def cwd(original, tmp_path, monkeypatch):
    """A copy of `original`, as the current folder."""
    monkeypatch.chdir(tmp_path)
    return shutil.copytree(original, tmp_path, dirs_exist_ok=True)


def run(command):
    """Run "eval --data root", "raw DRIVE ROOT", "metrics GT EST" or the like -> its exit code."""
    first, *rest = words = shlex.split(command)
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
    before, code = files_of("."), run(command)
    out, err = capsys.readouterr()
    lines = error_lines(err)
    assert code == 2 and len(lines) == 1 and re.search(pattern, lines[0]), err
    assert "Traceback" not in err + out and files_of(".") == before


def read(path):
    """The content of a JSON file, or of weights and checkpoints."""
    if path.endswith(".json"):
        return json.loads(Path(path).read_text())
    return torch.load(path, weights_only=True)


def figures(out, name):
    """The numbers in a row of a printed table, NaN for "-"."""
    words = re.search(rf"^{name}(?: \*)? +(\S.*)$", out, re.M)[1].split()
    return [float(word.replace("-", "nan")) for word in words]


def during(monkeypatch, module, name, action):
    """Let `action` happen once in the middle of something: just before module.name is called."""
    function = getattr(module, name)

    def replacement(*arguments, **options):
        monkeypatch.setattr(module, name, function)
        action()
        return function(*arguments, **options)

    monkeypatch.setattr(module, name, replacement)


class Mischief:
    """Makes a folder when it is unpickled, as a malicious file might run code."""

    def __reduce__(self):
        return os.mkdir, ("mischief",)


# Functions that return a function, which changes files


def put(path, content):
    """Write text, bytes or an array to a file, or apply a function to its bytes."""
    def change():
        new = content(Path(path).read_bytes()) if callable(content) else content
        if isinstance(new, np.ndarray):
            np.save(path, new, allow_pickle=True)
        else:
            Path(path).write_bytes(new.encode() if isinstance(new, str) else new)

    return change


def delete(*paths):
    return lambda: [shutil.rmtree(path) if Path(path).is_dir() else os.remove(path)
                    for path in paths]


def change_in_the_middle(path):
    """Change a scan but keep the file's size and modification time, as `rsync -t` may do."""
    def change():
        data, stat = bytearray(Path(path).read_bytes()), os.stat(path)
        data[len(data) // 32 * 16 + 3] ^= 128  # flips the sign of an x
        Path(path).write_bytes(data)
        os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))

    return change


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
    T_gt, E = drive(rng, n), from_vector(size * rng.normal(size=(n - 1, 6)))
    start = from_vector(rng.normal(size=6) * [50, 50, 50, 90, 60, 90])  # must not matter
    T_est = start @ d3dlo.accumulate(np.linalg.inv(T_gt[:-1]) @ T_gt[1:] @ E)

    expected, got = devkit_errors(T_gt, T_est), metrics.segment_errors(T_gt, T_est)
    fields = {"first": 0, "last": 0, "length": 0, "t_err": 1e-7, "r_err": 1e-6}
    for (field, tolerance), column in zip(fields.items(), expected.T, strict=True):
        assert_allclose(got[field], column, rtol=tolerance, atol=tolerance)
    # E_t and E_r are means over the segments of all sequences
    pooled = np.r_[expected, expected[:3]][:, 3:]
    means = pooled.mean(0) if len(pooled) else [np.nan, np.nan]
    assert_allclose(metrics.kitti_errors([got, got[:3]]), means, rtol=1e-6, atol=1e-6)

    t = np.linalg.norm(E[:, :3, 3], axis=1)
    r = np.degrees(Rotation.from_matrix(E[:, :3, :3]).magnitude())
    assert_allclose(metrics.step_errors(T_gt, T_est), np.stack([t, r], 1), atol=1e-9)
    squares = [x * x + y * y + z * z for x, y, z in (T_gt - T_est)[:, :3, 3]]
    assert metrics.absolute_error(T_gt, T_est) == pytest.approx(math.sqrt(sum(squares) / n))
    for error in (metrics.segment_errors, metrics.step_errors, metrics.absolute_error):
        with pytest.raises(ValueError, match=f"{n + 1}.*{n}"):
            error(straight_path(n + 1), T_est)


@given(SEED, st.integers(1, 30))
def test_pose_files_survive_the_round_trip_also_with_a_byte_order_mark(tmp_path, seed, n):
    T, path = random_trajectory(generator(seed), n), tmp_path / "new" / "a.txt"
    metrics.write_poses(path, T)
    assert os.listdir(path.parent) == ["a.txt"] and np.loadtxt(path, ndmin=2).shape == (n, 12)
    for encoding in ("utf-8", "utf-8-sig"):  # the second writes the mark
        path.write_text(path.read_text(), encoding=encoding)
        assert_allclose(metrics.read_poses(path), T, rtol=1e-8, atol=1e-8)


@given(SEED, st.sampled_from([-1, 1]))
def test_the_view_from_above_is_the_same_for_camera_and_lidar_poses(seed, gear):
    lidar = random_trajectory(generator(seed), 50, [gear, 0.05, 0.05, 1, 1, 6])  # or in reverse
    axes = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])  # the camera's
    for T, labels in ((lidar, ("LiDAR -y, right [m]", "LiDAR x, forward [m]")),
                      (axes @ lidar @ axes.T, ("camera x, right [m]", "camera z, forward [m]"))):
        view, *got = metrics.view_from_above(T)
        assert_allclose(view @ T[:, :3, 3].T, [-lidar[:, 1, 3], lidar[:, 0, 3]], atol=1e-9)
        assert tuple(got) == labels


def test_metrics_prints_the_errors_of_files_and_folders(cwd, capsys):
    gt, est = straight_path(300), straight_path(300, 1.01)
    for name, T in {"gt/03": gt, "gt/07": gt[:200], "est/03": est, "est/07": gt[:200]}.items():
        metrics.write_poses(f"{name}.txt", T)
    E_t, same = devkit_errors(gt, est)[:, 3], devkit_errors(gt[:200], gt[:200])[:, 3]
    ate = 0.01 * math.sqrt(sum(i * i for i in range(300)) / 300)
    for names in ("gt/03.txt est/03.txt", "gt est"):
        assert run(f"metrics {names}") == 0
        out = capsys.readouterr().out
        expected = [len(E_t), E_t.mean(), 0, 0.01, 0, ate, 0.01, 0]
        assert_allclose(figures(out, "03"), expected, atol=6e-4)
    pooled = np.r_[E_t, same]
    assert_allclose(figures(out, "all")[:2], [len(pooled), pooled.mean()], atol=6e-4)
    assert figures(out, "07")[1] == 0 and figures(out, "200 m")[1] == 0.804  # (8 * 1.005 + 0) / 10


# ------------------------------------------------------------------------------------------------
# The data


@given(SEED, st.floats(-8, 8), st.floats(-8, 8))
def test_remove_plane_removes_points_within_15_cm_of_the_ground_and_nothing_else(
        seed, roll, pitch):
    rng = generator(seed)
    heights = np.r_[rng.normal(0, 0.02, 3000), [-0.12, 0.12] * 20, [-0.18, 0.18] * 20,
                    rng.uniform(0.4, 3, 1500)]
    points = np.c_[rng.uniform(-20, 20, (4580, 2)), heights, np.ones(4580)]
    points = (points @ from_vector([0, 0, -1.7, roll, pitch, 0]).T)[:, :3]
    order = rng.permutation(4582)
    scan = np.r_[points, np.full((2, 3), np.nan)].astype(np.float32)[order]
    assert_array_equal(kitti.remove_plane(scan, seed=seed), scan[order >= 3040])
    for N, thick in ((500, 0), (5000, 0.1), (2, 0), (0, 0)):  # walls, and too few points
        wall = generator(0).uniform(-9, 9, (N, 3)) * [thick, 1, 1]
        assert_array_equal(kitti.remove_plane(wall), wall)


def test_invalid_points_are_counted_and_far_points_and_the_ground_are_dropped():
    rng = generator(0)
    ground = np.c_[rng.uniform(-20, 20, (3000, 2)), np.full(3000, -1.7), rng.random(3000)]
    near, far = random_scan(rng, 50) + [0, 0, 3, 0], [[60, 0, 9, 0.5], [30, -40.1, 9, 0.5]]
    bad = [[np.nan, 0, 0, 0], [0, 0, 0, np.inf], [0, 0, 0, 1e6], [0, 900, 500, 0], [1e30, 0, 0, 0]]
    scan = np.r_[near, bad, far, ground].astype(np.float32)
    for max_range, plane, kept in ((50, False, [near]), (50, True, [near, ground]),
                                   (None, False, [near, far]), (None, True, [near, far, ground])):
        points, invalid = kitti.usable_points(scan, max_range, plane)
        assert_array_equal(points, np.concatenate(kept).astype(np.float32))
        assert invalid == 5


GAP = "3 scans are missing, the first after 000003.npy"


@pytest.mark.parametrize("name, options, removed, divisor, note", [
    ("{}.pcd.bin", {}, (), 1, ""), ("no-{}-of-12.npy", {}, (), 1, ""),
    ("{}.npy", dict(scale=255), (), 255, "by 255"), ("{}.npy", dict(scale=2), (), 255, "by 255"),
    ("{}.npy", dict(columns=3), (), 1, "no intensities"),
    ("{}.npy", dict(scale=0), (), 1, "no intensities"),
    ("{:06d}.npy", {}, (4, 5, 9), 1, GAP), ("{}00000.npy", {}, (4, 5), 1, ""),  # these are times
    ("{:06d}.npy", {}, (1, 2, 12), 1, ""), ("{:06d}.npy", {}, range(2, 12, 2), 1, "")])
def test_a_folder_of_scans_is_one_sequence_in_natural_order(
        tmp_path, name, options, removed, divisor, note):
    folder = tmp_path / "new"
    scans = write_folder(f"{folder}/{name}", **options)
    for i in removed:
        (folder / name.format(i)).unlink()
        del scans[folder / name.format(i)]
    (folder / "._1.bin").write_text("left by another system")
    s, = kitti.open_sequences(folder)
    assert kitti.sequence_names(folder) == [s.name] == ["new"] and s.poses is None
    for i, scan in enumerate(scans.values()):  # 2 comes before 10
        intensity = scan[:, 3] / np.float32(divisor) if scan.shape[1] == 4 else np.zeros(len(scan))
        assert_array_equal(s.scan(i), np.c_[scan[:, :3], intensity])
    assert len(s) == len(scans) and note in "".join(s.notes) and len(s.notes) == 1 + bool(note)
    assert_allclose(s.times, np.arange(len(s)) / 10)
    assert "10 scans a second" in s.notes[-1]
    times = 1.3e9 + np.arange(len(s)) * 0.25
    np.savetxt(folder / "times.txt", times, fmt="%.6f")
    s, = kitti.open_sequences(folder)
    assert_allclose(s.times, times, rtol=0, atol=1e-6)
    assert len(s.notes) == bool(note)


def test_the_cache_equals_scan_records_and_is_computed_again_when_anything_changes(
        cwd, monkeypatch):
    def load(**changes):
        """Check the records. Returns the names and times of the cache's files."""
        config, sequences = replace(SMALL, **changes), kitti.open_sequences("root")
        for s, records in zip(sequences, load_records(sequences, config), strict=True):
            expected = np.concatenate([scan_records(s.scan(i), config) for i in range(len(s))])
            expected["crc"] = [zlib.crc32(path.read_bytes()) for path in s.scan_paths]
            assert records.tobytes() == expected.tobytes()
        return {path: path.stat().st_mtime_ns for path in Path("cache").iterdir()}

    during(monkeypatch, kitti, "replacing", load)  # another process may do the same meanwhile
    first = load()
    assert len(first) == 2 and load() == first  # the second time nothing is computed
    change_in_the_middle("root/sequences/03/velodyne/000002.bin")()
    assert len(load()) == 3  # only the sequence that changed
    for i, change in enumerate((
            dict(sa1=Layer(1.0, *SMALL.sa1[1:])), dict(sa1=Layer(2.0, 32, 5, (4, 8, 16))),
            dict(sa2=Layer(4.0, 12, 8, (32, 32))), dict(sa2=Layer(3.0, *SMALL.sa2[1:])),
            dict(sa3=Layer(7.0, *SMALL.sa3[1:])), dict(plane=False), dict(max_range=9.0))):
        assert len(load(**change)) == 5 + 2 * i
    assert len(load(fe=Layer(None, None, 3, (16, 32)), lr=5.0)) == 17  # unrelated
    file = min(first)  # of sequence 00
    good = file.read_bytes()
    for bad in (good[:-1], good[:200], b"", b"noise" * 40, pickle.dumps(Mischief())):
        file.write_bytes(bad)
        load()
        assert file.read_bytes() == good and not Path("mischief").exists()


def test_a_fingerprint_depends_on_the_scans_and_poses_and_not_on_names_or_times(cwd):
    crcs = np.arange(15, dtype=np.uint32)
    a, b = kitti.open_sequences("root")
    shutil.copytree(a.folder, "copy/sequences/new", copy_function=shutil.copyfile)
    Path("copy/poses").mkdir()
    shutil.copyfile(POSES, "copy/poses/new.txt")
    copy, = kitti.open_sequences("copy")
    assert a.fingerprint(crcs) == copy.fingerprint(crcs) and copy.name == "new"
    assert len({a.fingerprint(crcs), b.fingerprint(crcs), a.fingerprint(crcs[::-1])}) == 3


# ------------------------------------------------------------------------------------------------
# The simulated city


def test_the_city_is_the_same_with_any_workers_and_existing_sequences_are_kept(tmp_path):
    def simulate(to, names, **more):
        root = kitti.simulate(tmp_path / to, sequences=names, scans=9, azimuth=200, **more)
        return files_of(root)

    made = simulate("one", ("00", "07"), workers=1)
    assert simulate("two", ("07", "00"), workers=2) == made
    for name, data in simulate("other", ("07",), seed=1).items():
        assert not name.endswith((".bin", "07.txt")) or data != made[name]
    scan = "sequences/00/velodyne/000005.bin"
    (tmp_path / "two" / scan).write_bytes(b"there")
    assert simulate("two", ("00", "07"))[scan] == b"there"


def test_simulated_scans_are_in_kittis_layout_and_fit_their_poses(tmp_path):
    s, = kitti.open_sequences(kitti.simulate(tmp_path, sequences=["02"], scans=3, azimuth=900))
    assert len(s) == 3 and np.allclose(s.poses[0], np.eye(4))
    # Tr is far from the identity, so that confused frames would be noticed
    assert np.abs(s.Tr[:3, :3] - np.eye(3)).max() > 0.9 and np.abs(s.Tr[:3, 3]).max() > 0.1
    for i, T in enumerate(s.motions()):
        p, q = s.scan(i), s.scan(i + 1)
        distances = np.linalg.norm(p[:, :3], axis=1)
        assert len(p) > 15000 and 1 < distances.min() and distances.max() < 80.5
        assert 0 <= p[:, 3].min() and p[:, 3].max() <= 1
        q, tree = q[q[:, 2] > -1.2, :3], cKDTree(p[:, :3])  # the ground fits every motion along it
        right, *wrong = (np.median(tree.query(q @ M[:3, :3].T + M[:3, 3])[0])
                         for M in (T, np.eye(4), invert(T), kitti.velo_to_camera(T, s.Tr)))
        assert right < 0.1 and min(wrong) > 3 * right


@pytest.mark.parametrize("name", ["01", "05", "06"])
def test_simulated_vehicles_drive_beside_us_and_never_into_us(name):
    world, u, near = kitti._world(name, 0, 170), np.linspace(-1, 1, 15), []
    for i, T in enumerate(world.T_flat):
        x, y, yaw, half_x, half_y = world.moving(i)[:, :5].T[:, :, None, None]
        along, across = half_x * u[:, None], half_y * u  # points that cover a vehicle in plan
        x = x + along * np.cos(yaw) - across * np.sin(yaw) - T[0, 3]
        y = y + along * np.sin(yaw) + across * np.cos(yaw) - T[1, 3]
        ahead, left = x * T[0, 0] + y * T[1, 0], x * T[0, 1] + y * T[1, 1]
        assert not ((np.abs(ahead) < 2.4) & (np.abs(left) < 0.9)).any()  # our own car
        near.append((np.hypot(x, y).min((1, 2)) < 30).sum())
    assert np.mean(near) > 4  # a vehicle is a body and a cabin


# ------------------------------------------------------------------------------------------------
# Raw drives


def move_and_link():
    shutil.move(DRIVE, "elsewhere")
    Path(DRIVE).symlink_to(Path("elsewhere").resolve())


def blank_lines(path, numbers):
    return put(path, lambda text: b"\n".join(b"" if i in numbers else line for i, line
                                             in enumerate(text.splitlines())))


@table("change, parts", {  # what to do to the drive, first and last scan of each sequence
    "whole": (lambda: None, [(0, 11)]), "a symbolic link": (move_and_link, [(0, 11)]),
    "scans": (delete(*map(RAW_SCAN.format, (3, 4))), [(0, 2), (5, 11)]),
    "a time": (blank_lines(SCAN_TIMES, [7]), [(0, 6), (8, 11)]),
    "packets": (delete(*map(PACKET.format, (4, 5, 6))), [(0, 4), (7, 11)]),
    "times of packets": (blank_lines(PACKET_TIMES, (4, 5, 6)), [(0, 4), (7, 11)])})
@pytest.mark.parametrize("linked", [True, False])
def test_a_raw_drive_is_converted_with_poses_at_the_times_of_its_scans_and_split_at_gaps(
        tmp_path, monkeypatch, capsys, change, parts, linked):
    monkeypatch.chdir(tmp_path)
    truth, Tr = write_raw()
    change()
    if not linked:
        monkeypatch.setattr(os, "link", full)
    assert run(f"raw {DRIVE} new") == 0
    (out, err), sequences, name = capsys.readouterr(), kitti.open_sequences("new"), DRIVE[11:-5]
    assert [s.name for s in sequences] == [name] * (len(parts) == 1) or [f"{name}-1", f"{name}-2"]
    assert ("split" in out) == (len(parts) > 1) and error_lines(err) == []
    for s, (first, last) in zip(sequences, parts, strict=True):
        assert f"{s.name}: scans {first} to {last}, " in out
        expected = invert(truth[first]) @ truth[first:last + 1]
        assert_allclose(s.poses_cam, expected, atol=1e-3)  # 1 mm
        assert metrics.step_errors(expected, s.poses_cam).max() < 1e-3
        assert_allclose(s.Tr, Tr, atol=1e-9)
        assert_allclose(np.loadtxt(s.folder / "times.txt"), 0.1 * np.arange(len(s)), atol=0.01)
        for i, path in enumerate(s.scan_paths):
            scan = Path(RAW_SCAN.format(first + i))
            assert path.samefile(scan) == linked and not path.is_symlink()
            assert path.read_bytes() == scan.read_bytes()
    refused(f"raw {DRIVE} new", "drive_0013.* already exists.*choose", capsys)


# ------------------------------------------------------------------------------------------------
# The command eval


def test_eval_writes_what_it_prints_and_agrees_with_the_metric(cwd, capsys):
    shutil.copytree("root/sequences/03", "root/sequences/11")  # without ground truth
    assert run(EVAL) == 0
    (out, err), results = capsys.readouterr(), read("out/results.json")
    sequences, splits, keys = results["sequences"], results["splits"], (
        "segments", "E_t", "E_r", "t_step_m", "r_step_deg")
    assert list(results) == "weights data refine sequences splits pooled lengths".split()
    assert sorted(os.listdir("out")) == ["00.txt", "03.txt", "11.txt", "results.json"]
    assert list(sequences) == ["00", "03", "11"] and list(splits) == ["train", "test"]
    assert sequences["11"]["E_t"] is None and error_lines(err) == []
    for name, s in [*sequences.items(), *splits.items(), ("all", results["pooled"])]:
        assert_allclose(figures(out, name), np.array([s[key] for key in keys], float), atol=6e-4)
        assert s["trained_on"] is False and f"{name} *" not in out

    # Compute the trajectories from the scans, and the errors from the trajectories
    segments, motion = [], from_vector(MEAN_MOTION)
    for s, split in zip(kitti.open_sequences("root", ["00", "03"]), splits.values()):
        T = metrics.read_poses(f"out/{s.name}.txt")
        pairs = [relative_pose(s.scan(i), s.scan(i + 1), "w.pt") for i in range(14)]
        estimates = {"network": invert(s.Tr) @ T @ s.Tr, "standing still": [np.eye(4)] * 15,
                     "mean training motion": [np.linalg.matrix_power(motion, i) for i in range(15)]}
        assert_allclose(estimates["network"], d3dlo.accumulate(pairs), rtol=1e-3, atol=1e-3)
        for name, T_velo in estimates.items():
            errors = devkit_errors(s.poses_cam, s.Tr @ T_velo @ invert(s.Tr))
            expected = [len(errors), *errors[:, 3:].mean(0),
                        *metrics.step_errors(s.poses, T_velo).mean(0)]
            got = (split | {"network": sequences[s.name]})[name]
            assert_allclose([got[key] for key in keys], expected, rtol=1e-5)
            segments += [*errors] * (name == "network")
    segments = np.array(segments)
    assert results["pooled"]["E_t"] == pytest.approx(segments[:, 3].mean())
    for length in np.unique(segments[:, 2]):
        expected = segments[segments[:, 2] == length, 3].mean()
        assert results["lengths"][f"{length:.0f} m"]["E_t"] == pytest.approx(expected)
    assert run("metrics root/poses out") == 0  # in the camera's frame: other errors per step
    expected = [sequences["03"][key] for key in keys[:3]]
    assert_allclose(figures(capsys.readouterr().out, "03")[:3], expected, atol=6e-4)


@pytest.mark.parametrize("refine", [0, 2])
def test_eval_of_a_plain_folder_writes_its_trajectory_and_refines_as_often_as_asked(
        cwd, capsys, refine):
    Path("drive/times.txt").write_text("\n".join(f"{1.3e9 + i}" for i in range(12)))
    assert run(f"eval --data drive --weights w.pt --refine {refine} --out out") == 0
    out, err = capsys.readouterr()
    assert sorted(os.listdir("out")) == ["poses.tum", "poses.txt", "results.json"]
    poses, rows = metrics.read_poses("out/poses.txt"), np.loadtxt("out/poses.tum")
    odometry = d3dlo.Odometry("w.pt", refine=refine)
    expected = [odometry.register(np.load(f"drive/scan {i}.npy")) for i in range(1, 13)]
    assert_allclose(poses, expected, rtol=1e-3, atol=1e-3)
    times, q = 1.3e9 + np.arange(12), rows[:, 4:]
    assert_allclose(rows[:, :4], np.c_[times, poses[:, :3, 3]], rtol=0, atol=1e-6)
    assert_allclose(Rotation.from_quat(q).as_matrix(), poses[:, :3, :3], atol=1e-6)
    assert np.allclose(np.linalg.norm(q, axis=1), 1) and (q[:, 3] >= 0).all()
    path = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum()
    assert read("out/results.json") == {"weights": "w.pt", "data": "drive", "refine": refine,
                                        "scans": 12, "path_m": pytest.approx(path)}
    assert f"drive: 12 scans, path of {path:.1f} m" in out and error_lines(err) == []


def test_without_data_the_city_is_simulated_and_trained_on_with_the_short_recipe(cwd, monkeypatch):
    simulate, held_out = kitti.simulate, [*SPLITS["test"], *SPLITS["validation"]]
    monkeypatch.setattr(kitti, "simulate", lambda root, sequences: simulate(
        root, sequences=sequences, scans=2, azimuth=100))
    assert run("eval --weights w.pt --out out") == 0
    assert list(read("out/results.json")["sequences"]) == held_out
    assert sorted(os.listdir("data/simulated/sequences")) == sorted(held_out)
    assert run("train --weights w.pt --epochs 1 --out new") == 0
    made = read("new/config.json")
    assert made["config"] == replace(SMALL, **SHORT | {"epochs": 1}).as_dict()
    assert made["arguments"]["sequences"] == list(SPLITS["train"])
    assert list(read("new/results/results.json")["sequences"]) == held_out


# ------------------------------------------------------------------------------------------------
# The command train


def test_train_stores_a_run_that_eval_reads_and_marks_what_it_was_trained_on(cwd, capsys):
    def starred(data, weights, out):
        assert run(f"eval --data {data} --weights {weights} --out {out}") == 0
        return re.findall(r"^(\w+) \*", capsys.readouterr().out, re.M)

    assert run("train --data root --weights w.pt --epochs 2 --out new") == 0
    (out, err), made = capsys.readouterr(), read("new/config.json")
    assert error_lines(err) == [] and Path("new/log.txt").read_text() == out
    assert sorted(os.listdir("new")) == [
        "checkpoint.pt", "config.json", "log.txt", "results", "weights.pt"]
    assert re.findall(r"^epoch (.)/2: loss [\d.]+, test loss [\d.]+, ", out, re.M) == ["1", "2"]
    assert made["config"] == replace(SMALL, epochs=2, swap="random").as_dict()  # the paper's
    assert made["versions"].keys() == {"commit", "d3dlo", "python", "numpy", "scipy", "torch"}
    motions = kitti.open_sequences("root", "00")[0].motions()
    assert_allclose(read("new/weights.pt")["mean_motion"], to_vector(motions).mean(0), atol=1e-6)
    assert starred("root", "new", "out") == ["00", "train", "all"]
    before, after = read("new/results/results.json"), read("out/results.json")
    assert before["sequences"]["03"] == after["sequences"]["03"]

    # Without sequences of the training split, train on all that are not held out. Training that
    # starts from weights remembers what these were trained on
    write_root("other", ["a", "b", "07"], seed=1)
    assert run("train --data other --weights new --epochs 1 --out later") == 0
    assert list(read("later/results/results.json")["sequences"]) == ["07"]
    capsys.readouterr()
    assert starred("other", "later", "other-out") == ["a", "b", "all"]
    assert starred("root", "later", "root-out") == ["00", "train", "all"]
    change_in_the_middle(f"{SCANS}/000005.bin")()
    refused("train --out new --resume", "data has changed.*resume it with", capsys)


def test_every_option_of_train_has_an_effect(cwd):
    def train(options):
        assert run(f"train --data root --out new {options}") == 0
        log, made = Path("new/log.txt").read_text(), read("new/weights.pt")
        shutil.rmtree("new")
        return log, made["config"], made["model"]

    small = "--weights w.pt --epochs 1 "
    first, _, model = train(small)
    for option, words in {
            "--epochs 3": "epoch 3/3", "--batch 7": "epochs of 2 batches", "--lr 0.25": "rate 2.5e-01",
            "--sequences 03": "pairs of scans of 03", "--short": "rate 4.0e-04"}.items():
        log = train(small + option)[0]
        assert words in log and words not in first
    for option, same in {"--seed 0": True, "--seed 1": False}.items():
        other = train(small + option)[2]
        assert all(torch.equal(model[name], other[name]) for name in model) == same

    shutil.rmtree("root/sequences/03")
    for i in range(15):  # enough points for the network of Table 1
        random_scan(generator(i), 1200).tofile(f"{SCANS}/{i:06d}.bin")
    options = "--epochs 1 --neighbors 5 --no-plane --lr 1e-9 --seed "
    (_, config, model), (*_, other) = train(options + "0"), train(options + "1")
    sa1 = Layer(1.0, 1024, 5, (4, 8, 16, 32))
    assert config == Config(epochs=1, lr=1e-9, plane=False, sa1=sa1).as_dict()
    assert (model["mlp.0.weight"] - other["mlp.0.weight"]).abs().max() > 1e-3  # initial weights


LONG = "train --data root --weights w.pt --short --epochs 4 --batch 4 --out"


def train_until(action):
    """Train, and let something happen in the middle of writing the fourth checkpoint."""
    def save(content, file, save=torch.save):
        saved.append(file)
        if len(saved) == 4:
            file.write(b"half")
            file.flush()
            action()
        save(content, file)

    saved = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch, "save", save)
        patch.setattr(d3dlo, "CHECKPOINT_EVERY", 0)
        patch.setattr(sys, "stdout", sys.stdout)  # to restore it
        return run(f"{LONG} new")


def close_stdout():
    """As when `head` has read enough."""
    reader, writer = os.pipe()
    os.close(reader)
    sys.stdout = io.TextIOWrapper(io.FileIO(writer, "w"), write_through=True)


ENDS = {"kill -9": (lambda: os.kill(os.getpid(), signal.SIGKILL), -signal.SIGKILL, None),
        "SIGTERM": (lambda: signal.raise_signal(signal.SIGTERM), 130, "to continue: .* --resume"),
        "closed stdout": (close_stdout, 2, "standard output was closed; .* --resume")}


@pytest.mark.parametrize("end", ENDS)
def test_an_interrupted_training_run_is_resumed_to_the_same_bits(cwd, capsys, end):
    action, code, line = ENDS[end]
    assert run(f"{LONG} whole") == 0
    capsys.readouterr()
    if line:
        assert train_until(action) == code
        message, = error_lines(capsys.readouterr().err)
        assert re.search(line, message)
    else:  # in a process of its own
        script = f"import {__name__} as t; t.train_until(t.ENDS[{end!r}][0])"
        environment = os.environ | {"PYTHONPATH": str(HERE)}
        ran = subprocess.run([sys.executable, "-c", script], env=environment, timeout=60)
        assert ran.returncode == code
    assert 0 < read("new/checkpoint.pt")["step"] < read("whole/checkpoint.pt")["step"]
    Path("new/results").mkdir()
    Path("new/results/old").write_text("of an earlier end")
    assert run("train --out new --resume") == 0
    assert sorted(os.listdir("new/results")) == ["03.txt", "results.json"]
    new, whole = read("new/weights.pt")["model"], read("whole/weights.pt")["model"]
    assert all(torch.equal(new[name], whole[name]) for name in whole)


def full(*arguments, **options):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize("command, module, name, file", [
    (EVAL, np, "savetxt", "out/00.txt"), (TRAIN, torch, "save", "new/weights.pt"),
    (EVAL, Path, "write_text", "out/results.json"),
    (EVAL, np.lib.format, "write_array_header_1_0", "cache/00-")])
def test_a_full_disk_fails_with_one_line_that_names_the_file(
        cwd, monkeypatch, capsys, command, module, name, file):
    monkeypatch.setattr(module, name, full)
    assert run(command) == 2
    line, = error_lines(capsys.readouterr().err)
    assert "No space left on device" in line and file in line


UNGUARDED = """
import multiprocessing, kitti
multiprocessing.set_start_method("spawn", force=True)
print([*kitti.in_processes(abs, [1, 2], workers=1)])
"""


def test_a_script_without_a_main_guard_gets_an_error_that_explains_it(tmp_path):
    (tmp_path / "script.py").write_text(UNGUARDED)
    ran = subprocess.run([sys.executable, tmp_path / "script.py"], timeout=60, text=True,
                         env=os.environ | {"PYTHONPATH": str(HERE)}, stderr=subprocess.PIPE)
    assert "needs the line if __name__ == '__main__':" in ran.stderr.splitlines()[-1]


def test_pictures_are_drawn_if_matplotlib_is_installed(cwd, monkeypatch, capsys):
    draw = "metrics root/poses root/poses --plot"
    with monkeypatch.context() as patch:  # as if matplotlib were not installed
        patch.setitem(sys.modules, "matplotlib.figure", None)
        for command in (f"{draw} a.png", f"{EVAL} --plot"):
            refused(command, "matplotlib.*pip install", capsys)
        assert not Path("cache").exists()  # refused before the work
    pytest.importorskip("matplotlib")
    assert run(f"{EVAL} --plot") == 0
    starts = {"out/plot.png": b"\x89PNG", "a.png": b"\x89PNG", "b.pdf": b"%PDF", "c.svg": b"<?xml"}
    for name, start in starts.items():
        assert run(f"{draw} {name}") == 0 or name == "out/plot.png"
        assert Path(name).read_bytes().startswith(start)


# ------------------------------------------------------------------------------------------------
# Output folders


@pytest.mark.parametrize("command", ["eval", "train --epochs 1"])
@pytest.mark.parametrize("out", [
    "root", "root/poses", "root/poses/new", "root/sequences/00/new", "root/sequences/new",
    "link", "link/new", "root/poses/../poses/new", "run", "w.pt"])
def test_an_output_folder_in_the_data_or_with_content_is_refused(cwd, capsys, command, out):
    Path("link").symlink_to("root/poses")
    refused(f"{command} --data root --weights w.pt --out {out}", "--out", capsys)


@pytest.mark.parametrize("command", [EVAL, TRAIN])
@pytest.mark.parametrize("default", [True, False])
def test_two_processes_never_share_an_output_folder(cwd, monkeypatch, capsys, command, default):
    monkeypatch.setattr(time, "strftime", lambda form: form.replace("%S", "0"))  # the same second
    command, codes = command.partition(" --out")[0] if default else command, []
    during(monkeypatch, d3dlo, "claim_output", lambda: codes.append(run(command)))
    codes.append(run(command))
    lines = error_lines(capsys.readouterr().err)
    if default:
        made = [sorted(os.listdir(path)) for path in Path(".").glob("r*s/*")]  # runs or results
        assert codes == [0, 0] and lines == [] and len(made) == 2 and made[0] == made[1]
    else:
        assert codes == [0, 2] and len(lines) == 1 and re.search("--out.*choose", lines[0])


# ------------------------------------------------------------------------------------------------
# Bad input


def five_floats():
    """Replace the scans by nuScenes' format: x, y, z, intensity up to 255, number of the beam."""
    shutil.rmtree("drive")
    for path, scan in write_folder("drive/{}.bin", scale=255).items():
        np.c_[scan[:48], np.arange(48) % 32].astype(np.float32).tofile(path)


def weights(**changes):
    """A function that changes the content of w.pt. None removes a key."""
    return lambda: torch.save({key: value for key, value in (read("w.pt") | changes).items()
                               if value is not None}, "w.pt")


def cut(text):
    """Drop the last word."""
    return text.rstrip().rpartition(b" ")[0]


SCAN, NPY, CITY = f"{SCANS}/000003.bin", "drive/scan 1.npy", \
    "simulate city --sequences 07 --scans 2 --azimuth 100"
CASES = [  # commands, and {what the message must say: what spoils good data}
    ((EVAL, TRAIN), {
        "unpack.*ROOT/sequences/00/": delete("root/sequences"),
        "root has no scans.*unpack": delete("root/sequences/03", SCANS),
        "python kitti.py raw": lambda: os.rename("root/sequences", "root/a_drive_0005_sync"),
        "velodyne .*000003.bin.* unpack": delete(SCAN), "has 0 bytes": put(SCAN, b""),
        "000003.bin.* bytes.*unpack it again": put(SCAN, lambda data: data[:-3]),
        "000003.bin is not a KITTI scan.*save": put(SCAN, b"\x93NUMPY0123456789"),
        "000003.bin: 30 usable.*metres": put(SCAN, lambda data: data[:16 * 30]),
        f"{POSES} has 14 poses.*unpack": put(POSES, lambda text: text.partition(b"\n")[2]),
        f"{POSES}, line 15: 11 words.*correct": put(POSES, cut),
        f"{POSES}, line 15: 12": put(POSES, lambda text: cut(text) + b" inf"),
        f"{POSES}: pose 1 .*must be": put(POSES, lambda text: text.replace(b"\n", b"\n9", 1)),
        f"{POSES}: pose 0 .*must be": put(POSES, lambda text: b"-" + text),  # a mirror
        f"{POSES}: holds no pose; give": put(POSES, "\n\n"),
        f"{POSES}.*UTF-16.*save": put(POSES, lambda text: text.decode().encode("utf-16")),
        f"{CALIB} does not exist.*write the line": delete(CALIB),
        f"{CALIB} has no row 'Tr'.*write": put(CALIB, lambda text: text.partition(b"Tr")[0]),
        f"{CALIB} has no row 'Tr'.*numbers": put(CALIB, cut)}),
    (["eval --data drive --weights w.pt"], {
        r"1.bin: .*nuScenes.*reshape\(-1, 5\)": five_floats,
        "both.*move": put("drive/0.bin", "1" * 16),
        "scan 1.npy.* 300.*rescale": put(NPY, np.full((9, 4), 300)),
        "scan 1.npy.* -0.5": put(NPY, np.full((9, 4), -0.5)),
        r"scan 1.npy.*\(9, 5\).*save": put(NPY, np.ones((9, 5))),
        r"scan 1.npy.*\(0, 4\).*save": put(NPY, np.ones((0, 4))),
        "scan 1.npy.*numbers.*save": put(NPY, np.full((9, 4), "x")),
        "1.npy is damaged.*save": put(NPY, "damaged"), "1.npy.*save": put(NPY, np.array(Mischief())),
        "times.txt must hold 12": put("drive/times.txt", "1 2 3"),
        "times.txt .*increasing.*correct": put("drive/times.txt", "1\n" * 12),
        "times.txt .*seconds.*correct": put("drive/times.txt", "2011-09-26 10:00\n" * 12)}),
    ([f"raw {DRIVE} new"], {
        "velodyne_points/timestamps.txt does.*_0013_sync.zip": delete(SCAN_TIMES),
        "velodyne_points/data/0000000000.bin.*_sync.zip": delete(f"{DRIVE}/velodyne_points/data"),
        "oxts/data/0000000000.txt.*_sync.zip": delete(f"{DRIVE}/oxts/data"),
        "calib_cam_to_cam.txt.*_calib.zip": delete(f"{DATE}/calib_cam_to_cam.txt"),
        "oxts/timestamps.txt is damaged.*unpack": put(PACKET_TIMES, "2011-09-26 13:10:51.1\n"),
        "points/timestamps.txt is damaged.*unpack": put(SCAN_TIMES, "noon\n" * 12),
        "within 0.1 s.*unpack": put(PACKET_TIMES, "2011-09-28 13:10:51.1\n" * 12),
        "0005.txt is damaged.*30.*unpack": put(PACKET.format(5), cut),
        "0006.txt is": put(PACKET.format(6), lambda text: text.replace(b"77", b"nan", 1)),
        "0007.bin has 639 bytes": put(RAW_SCAN.format(7), lambda data: data[:-1]),
        "velo_to_cam.txt is damaged.*unpack": put(f"{DATE}/calib_velo_to_cam.txt", "T: 0 0 0"),
        "imu_to_velo.txt is damaged.*unpack": put(f"{DATE}/calib_imu_to_velo.txt", cut)}),
    ([EVAL, "train --weights w.pt --data root --out new"], {f"w.pt: .*{words}.*give": spoil for words, spoil in {
        "size mismatch": weights(config=Config().as_dict()), "config": weights(config=None),
        "epochs is 0": weights(config=SMALL.as_dict() | {"epochs": 0}),
        "model": weights(model=None), "seen": weights(seen=None), "checkpoint": weights(parts=[]),
        "damaged": weights(mean_motion=[math.nan] * 6), "safety": weights(model=Mischief()),
        "zip": put("w.pt", lambda data: pickle.dumps(Mischief(), protocol=2)),
        "D3DLO weights": put("w.pt", lambda data: data[:5000] + b"\0" + data[5001:]),
        "cannot": put("w.pt", lambda data: data[:-2000]), "": put("w.pt", ""),
        "read": lambda: torch.save([1.0], "w.pt")}.items()})]
BAD_ARGUMENTS = {
    "eval --data ''": "--data is empty; give", "train --out ''": "--out is empty; give",
    "eval --data root --sequences 42": "'42'.*choose", "eval --data gone": "gone: .*check",
    "eval --data root --sequences ../sequences/00": "../sequences/00.*choose",
    "eval --data w.pt": "w.pt is a file: give", "eval --data clouds": "clouds.*save .* as .npy",
    "eval --weights gone.pt": "gone.pt: no such.*give", "eval --weights root": "root/weights.*give",
    "eval --weights run/checkpoint.pt": "run/checkpoint.pt.*only --resume.*give",
    "eval --sequences 0O": "0O; available", "eval --device nonsense": "nonsense.*use cpu",
    "eval --device meta": "meta.*use cpu", "eval --refine -1": "refine must be.*-1",
    "eval --refine 101": "refine must be.*101", "train --resume": "config.json.*give.*--out",
    "train --resume --out run --epochs 3": "--resume.*give only --out",
    "train --sequences 00 0O": "0O; available", "train --data drive": "drive has no ground truth",
    "train --weights w.pt --no-plane": "--weights.*--no-plane",
    "train --weights w.pt --neighbors 8": "--weights.*do not combine it with --neighbors",
    "train --lr 0": "lr is 0.*must be", "train --lr nan": "lr is nan.*must be",
    "train --epochs 0": "epochs is 0.*must be", "train --batch 0": "batch is 0.*must be",
    "train --neighbors 99999999": "n_n is 99999999.*must be", "train --seed -1": "seed must be",
    f"train --seed {10**23}": "seed must be", "raw root new": "root is not a drive.*give",
    f"{CITY} --azimuth 200": "07.*choose another", f"{CITY} --seed 1": "07.*choose another",
    f"{CITY} --scans 0": "scans.*must be", f"{CITY} --azimuth 3": "azimuth.*must be",
    f"{CITY} --sequences ../x": "../x.*use", "simulate root --sequences 00": "00.*choose",
    f"metrics {POSES} gone.txt": "gone.txt", f"metrics root/poses {POSES}": "give two",
    "metrics root/poses clouds": "clouds.*give two",
    f"metrics {POSES} root/poses/03.txt --plot {POSES}": "--plot.*give",
    "metrics root/poses root/poses --plot new.jpg": "--plot new.jpg.*give"}


@pytest.mark.parametrize("command, spoil, words", [
    *((command, spoil, words) for commands, cases in CASES for command in commands
      for words, spoil in cases.items()),
    *((command, lambda: None, words) for command, words in BAD_ARGUMENTS.items())])
def test_bad_input_fails_with_one_line_that_names_it_and_writes_nothing(
        cwd, capsys, command, spoil, words):
    spoil()
    refused(command, words, capsys)
    assert not Path("mischief").exists()


# ------------------------------------------------------------------------------------------------
# The documentation


def test_python_in_the_documentation_runs_and_its_commands_parse(cwd, monkeypatch):
    def parse_only(parser, arguments=None, parse=argparse.ArgumentParser.parse_args):
        parse(parser, arguments)  # raises SystemExit(2) if they are invalid
        raise SystemExit("parsed")

    pages = [HERE / "README.md", *sorted(HERE.glob("docs/*.md"))]
    if len(pages) == 1:
        pytest.skip("the source distribution has no docs")
    text = "\n".join(page.read_text(encoding="utf-8") for page in pages)
    for block in re.findall(r"```python\n(.*?)```", text, re.S):
        exec(compile(block, "a page", "exec"), {})
    commands = re.findall(r"^(?:pip install \S+ && )?python (\S+\.py)([^#\n]*)", text, re.M)
    commands += re.findall(r"`python (\S+\.py)([^`]*)`", text)
    assert len(commands) > 20
    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parse_only)
    monkeypatch.syspath_prepend(HERE / "benchmarks")  # its scripts import each other
    for script, arguments in commands:
        if script.startswith("benchmarks") and not (HERE / "benchmarks").exists():
            continue
        monkeypatch.setattr(sys, "argv", [script, *arguments.split()])
        with pytest.raises(SystemExit, match="parsed"):
            runpy.run_path(str(HERE / script), run_name="__main__")


def test_the_version_is_printed(capsys):
    with pytest.raises(SystemExit, match="^0$"):
        run("--version")
    assert capsys.readouterr().out == f"d3dlo {d3dlo.__version__}\n"
