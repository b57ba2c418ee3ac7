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
SCANS, POSES, CALIB = "root/sequences/00/velodyne", "root/poses/00.txt", \
    "root/sequences/00/calib.txt"
DATE, DRIVE = "2011_09_26", "2011_09_26/2011_09_26_drive_0013_sync"
RAW_SCAN, PACKET = f"{DRIVE}/velodyne_points/data/000000000{{}}.bin", \
    f"{DRIVE}/oxts/data/000000000{{}}.txt"
SCAN_TIMES, PACKET_TIMES = f"{DRIVE}/velodyne_points/timestamps.txt", f"{DRIVE}/oxts/timestamps.txt"


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


def write_root(root, names, scans=15):
    """Random scans in KITTI's layout, about 11 m apart."""
    rng, Tr = generator(0), from_vector([0.1, -0.2, 0.3, -90, 0, -90])
    for name in names:
        folder = Path(root, "sequences", name)
        (folder / "velodyne").mkdir(parents=True)
        for i in range(scans):
            random_scan(rng, 60).tofile(folder / "velodyne" / f"{i:06d}.bin")
        (folder / "calib.txt").write_text(f"P0: 1 0 0 0 0 1 0 0 0 0 1 0\nTr: {numbers(Tr[:3])}\n")
        T = random_trajectory(rng, scans, (14, 0.1, 0.1, 0.3, 0.3, 1))
        metrics.write_poses(Path(root, "poses", f"{name}.txt"), T)


def write_folder(folder, name="scan {}.npy", scale=1, columns=4):
    """Write a plain folder of 12 random scans, numbered from 1. Returns {path: scan}."""
    scans = {}
    Path(folder).mkdir()
    for i in range(1, 13):
        scan = (random_scan(generator(i), 50) * np.float32([1, 1, 1, scale]))[:, :columns]
        scans[path := Path(folder, name.format(i))] = scan
        scan.tofile(path) if path.suffix == ".bin" else np.save(path, scan)
    return scans


def imu_pose(t):
    """T_wi (4,4) of the vehicle of `write_raw` after t seconds: 12 m/s on a climbing bend."""
    yaw, radius = 0.4 + 0.3 * t, 12 / 0.3
    position = [radius * np.sin(yaw), -radius * np.cos(yaw), 100 + 0.5 * t]  # east, north, up
    return from_vector([*position, *np.degrees([0.03, 0.05, yaw])])


def write_raw(scans=12):
    """Write a drive of KITTI's raw data. Returns the true poses of the rectified camera, and Tr."""
    rng = generator(0)
    scan_times = 0.1 * np.arange(scans) + rng.uniform(-0.004, 0.004, scans)
    packet_times = scan_times + 0.015 + rng.uniform(-0.01, 0.01, scans)
    for file, times in ((SCAN_TIMES, scan_times), (PACKET_TIMES, packet_times)):
        Path(file).with_name("data").mkdir(parents=True)
        # The drive goes on past midnight
        stamps = np.datetime64("2011-09-26T23:59:59.5", "ns") + (1e9 * times).astype(int)
        Path(file).write_text("\n".join(map(str, stamps)).replace("T", " "))

    scale = 6378137 * np.cos(np.radians(49))  # of Mercator at the first packet's latitude
    for i, t in enumerate(packet_times):
        random_scan(rng, 40).tofile(Path(DRIVE, f"velodyne_points/data/{i:010d}.bin"))
        T, yaw = imu_pose(t), 0.4 + 0.3 * t
        east, north, up = T[:3, 3] - imu_pose(packet_times[0])[:3, 3]
        mercator_y = np.arctanh(np.sin(np.radians(49))) + north / scale
        lat, lon = np.degrees(np.arcsin(np.tanh(mercator_y))), 8.4 + np.degrees(east / scale)
        packet = np.full(30, 77.0)  # the value of all fields that are not used
        packet[:8] = lat, lon, up, 0.03, 0.05, yaw, 12 * np.sin(yaw), 12 * np.cos(yaw)
        packet[10], packet[17:20] = 0.5, T[:3, :3].T @ [0, 0, 0.3]  # along the vehicle's axes
        Path(DRIVE, f"oxts/data/{i:010d}.txt").write_text(numbers(packet))

    T_velo_imu, T_cam_velo, rectify = from_vector(
        [[1, 2, 3, 2, 5, 1], [0, -0.1, -0.3, -90, 1, -91], [0, 0, 0, 1, 2, 3]])
    for name, T in ("imu_to_velo", T_velo_imu), ("velo_to_cam", T_cam_velo):
        Path(DATE, f"calib_{name}.txt").write_text(
            f"calib_time: 25-May-2012\nR: {numbers(T[:3, :3])}\nT: {numbers(T[:3, 3])}\n")
    Path(DATE, "calib_cam_to_cam.txt").write_text(f"R_rect_00: {numbers(rectify[:3, :3])}\n")
    T_imu_cam = np.linalg.inv(rectify @ T_cam_velo @ T_velo_imu)
    T_wc = [imu_pose(t) @ T_imu_cam for t in scan_times]
    return np.linalg.inv(T_wc[0]) @ T_wc, rectify @ T_cam_velo


@pytest.fixture(scope="session")
def original(tmp_path_factory):
    """A folder with data of all kinds, small weights and a training run. Read only."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder := tmp_path_factory.mktemp("original"))
        write_root("root", ("00", "03"))
        write_folder("drive")
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
    """Run a command such as "eval --data root", "raw DRIVE ROOT" or "metrics GT EST"."""
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


def read_json(path):
    return json.loads(Path(path).read_text())


def stored(path):
    return torch.load(path, weights_only=True)


def table_row(out, name):
    """The figures in a row of a printed table, without the star of sequences trained on."""
    return re.search(rf"^{name}(?: \*)? +(\S.*)$", out, re.M)[1].split()


def as_printed(s):
    """The numbers of a sequence or group in results.json, as a row of the printed table."""
    formats = {"segments": "d", "E_t": ".3f", "E_r": ".5f", "t_step_m": ".4f", "r_step_deg": ".4f"}
    return ["-" if s[key] is None else format(s[key], f) for key, f in formats.items()]


def during(monkeypatch, module, name, action):
    """Let `action` happen once in the middle of something: just before module.name is called."""
    function = getattr(module, name)

    def replacement(*arguments, **options):
        monkeypatch.setattr(module, name, function)
        action()
        return function(*arguments, **options)

    monkeypatch.setattr(module, name, replacement)


def change_in_the_middle(path):
    """Change a scan but keep the file's size and modification time, as `rsync -t` may do."""
    data, stat = bytearray(Path(path).read_bytes()), os.stat(path)
    data[len(data) // 32 * 16 + 3] ^= 128  # flips the sign of an x
    Path(path).write_bytes(data)
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))


class Mischief:
    """Makes a folder when it is unpickled, as a malicious file might run code."""

    def __reduce__(self):
        return os.mkdir, ("mischief",)


# Functions that return a function, which changes files


def put(path, content):
    """Write a text, bytes or an array to a file, or apply a function to its bytes."""
    def change():
        if isinstance(content, np.ndarray):
            return np.save(path, content, allow_pickle=True)
        new = content(Path(path).read_bytes()) if callable(content) else content
        return Path(path).write_bytes(new.encode() if isinstance(new, str) else new)

    return change


def delete(*paths):
    return lambda: [shutil.rmtree(path) if Path(path).is_dir() else os.remove(path)
                    for path in paths]


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


@given(SEED, st.sampled_from([0, 1e-9, 1e-4, 1, 179.9999, 180]))
def test_tum_files_hold_times_positions_and_unit_quaternions(tmp_path, seed, degrees):
    rng = generator(seed)
    axes = np.r_[rng.normal(size=(4, 3)), np.eye(3), -np.eye(3)]  # random axes and x, y, z
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    T = from_vector(rng.normal(size=(len(axes), 6)))
    T[:, :3, :3] = Rotation.from_rotvec(np.radians(degrees) * axes).as_matrix()
    times = 1.3e9 + np.cumsum(rng.uniform(0.05, 0.2, len(T)))  # seconds since 1970
    kitti.write_tum(tmp_path / "a.tum", T, times)
    rows = np.loadtxt(tmp_path / "a.tum")
    assert_allclose(rows[:, :4], np.c_[times, T[:, :3, 3]], rtol=0, atol=1e-6)
    assert_allclose(np.linalg.norm(rows[:, 4:], axis=1), 1, atol=1e-8)
    assert_allclose(Rotation.from_quat(rows[:, 4:]).as_matrix(), T[:, :3, :3], atol=1e-8)
    assert (rows[:, 7] >= 0).all() and os.listdir(tmp_path) == ["a.tum"]


@given(SEED, st.sampled_from([-1, 1]))
def test_the_view_from_above_is_the_same_for_camera_and_lidar_poses(seed, gear):
    lidar = random_trajectory(generator(seed), 50, [gear, 0.05, 0.05, 1, 1, 6])  # or in reverse
    # Camera and LiDAR at the same place
    Tr = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    for T, labels in ((lidar, ["LiDAR -y, right [m]", "LiDAR x, forward [m]"]),
                      (Tr @ lidar @ Tr.T, ["camera x, right [m]", "camera z, forward [m]"])):
        view, *axes = metrics.view_from_above(T)
        assert axes == labels
        assert_allclose(view @ T[:, :3, 3].T, [-lidar[:, 1, 3], lidar[:, 0, 3]], atol=1e-9)


def test_metrics_prints_the_errors_of_files_and_folders(cwd, capsys):
    gt, est = straight_path(300), straight_path(300, 1.01)
    for name, T in {"gt/03": gt, "gt/07": gt[:200], "est/03": est, "est/07": gt[:200]}.items():
        metrics.write_poses(f"{name}.txt", T)
    expected, same = devkit_errors(gt, est)[:, 3], devkit_errors(gt[:200], gt[:200])[:, 3]
    ate = math.sqrt(sum((0.01 * i) ** 2 for i in range(300)) / 300)
    row = [str(len(expected)), f"{expected.mean():.3f}", "0.00000", "0.0100", "0.0000",
           f"{ate:.3f}", "0.0100", "0.0000"]
    assert run("metrics gt/03.txt est/03.txt") == 0
    out = capsys.readouterr().out
    assert table_row(out, "03") == row and table_row(out, "200 m")[1] == "1.005"
    assert run("metrics gt est") == 0
    out = capsys.readouterr().out
    assert table_row(out, "03") == row and table_row(out, "07")[1] == "0.000"
    assert table_row(out, "all")[1] == f"{np.r_[expected, same].mean():.3f}"


# ------------------------------------------------------------------------------------------------
# The data


@given(SEED, st.floats(-8, 8), st.floats(-8, 8))
def test_remove_plane_removes_points_within_15_cm_of_the_ground_and_nothing_else(
        seed, roll, pitch):
    rng = generator(seed)
    heights = np.r_[rng.normal(0, 0.02, 3000), rng.choice([-0.12, 0.12], 50),
                    rng.choice([-0.18, 0.18], 50), rng.uniform(0.4, 3, 1500)]
    points = np.c_[rng.uniform(-20, 20, (4600, 2)), heights, np.ones(4600)]
    points = (points @ from_vector([0, 0, -1.7, roll, pitch, 0]).T)[:, :3]
    order = rng.permutation(4602)
    scan = np.r_[points, np.full((2, 3), np.nan)].astype(np.float32)[order]
    assert_array_equal(kitti.remove_plane(scan, seed=seed), scan[order >= 3050])
    # A wall, a noisy wall, and too few points have no ground plane
    for N, thick in ((500, 0), (5000, 0.1), (2, 0), (0, 0)):
        wall = np.c_[rng.normal(size=N) * thick, rng.uniform(-9, 9, (N, 2))]
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
        assert_array_equal(points, np.concatenate(kept).astype(np.float32))
        assert invalid == 5


GAP = "3 scans are missing, the first after 000003.npy"


@table("options, removed, divisor, note", {
    "bin": (dict(name="{}.pcd.bin"), (), 1, ""), "npy": (dict(name="no-{}-of-12.npy"), (), 1, ""),
    "bright": (dict(scale=255), (), 255, "by 255"), "2": (dict(scale=2), (), 255, "by 255"),
    "three columns": (dict(columns=3), (), 1, "no intensities"),
    "zeros": (dict(scale=0), (), 1, "no intensities"),
    "missing": (dict(name="{:06d}.npy"), (4, 5, 9), 1, GAP),
    "times as names": (dict(name="{}00000.npy"), (4, 5, 9), 1, ""),
    "cut": (dict(name="{:06d}.npy"), (1, 2, 12), 1, ""),
    "every second": (dict(name="{:06d}.npy"), range(2, 12, 2), 1, "")})
def test_a_folder_of_scans_is_one_sequence_in_natural_order(
        tmp_path, options, removed, divisor, note):
    folder = tmp_path / "a folder"
    scans = write_folder(folder, **options)
    for i in removed:
        path = folder / options["name"].format(i)
        path.unlink()
        del scans[path]
    (folder / "._1.bin").write_text("left by another system")
    s, = kitti.open_sequences(folder)
    assert kitti.sequence_names(folder) == [s.name] == ["a folder"] and s.poses is None
    for i, (path, scan) in enumerate(scans.items()):  # 2 comes before 10
        intensity = scan[:, 3] / np.float32(divisor) if scan.shape[1] == 4 else np.zeros(len(scan))
        assert_array_equal(s.scan(i), np.c_[scan[:, :3], intensity], err_msg=path)
    assert len(s) == i + 1 and note in "".join(s.notes) and len(s.notes) == 1 + bool(note)
    assert "10 scans a second" in s.notes[-1]
    assert_allclose(s.times, np.arange(len(s)) / 10)
    times = 1.3e9 + np.arange(len(s)) * 0.25
    np.savetxt(folder / "times.txt", times, fmt="%.6f")
    s, = kitti.open_sequences(folder)
    assert_allclose(s.times, times, rtol=0, atol=1e-6)
    assert len(s.notes) == bool(note)


def test_the_cache_equals_scan_records_and_is_computed_again_when_anything_changes(
        cwd, monkeypatch):
    def load(config=SMALL):
        """Check the records. Returns the names and times of the cache's files."""
        sequences = kitti.open_sequences("root")
        for s, records in zip(sequences, load_records(sequences, config), strict=True):
            expected = np.concatenate([scan_records(s.scan(i), config) for i in range(len(s))])
            expected["crc"] = records["crc"]  # see the test of fingerprints
            assert records.tobytes() == expected.tobytes()
        return {path: path.stat().st_mtime_ns for path in Path("cache").iterdir()}

    during(monkeypatch, kitti, "replacing", load)  # another process may do the same meanwhile
    first = load()
    assert len(first) == 2 and load() == first  # the second time nothing is computed
    change_in_the_middle("root/sequences/03/velodyne/000002.bin")
    assert len(load()) == 3  # only the sequence that changed
    changes = [dict(sa1=Layer(1.0, *SMALL.sa1[1:])), dict(sa1=Layer(2.0, 32, 5, (4, 8, 16))),
               dict(sa2=Layer(4.0, 12, 8, (32, 32))), dict(sa2=Layer(3.0, *SMALL.sa2[1:])),
               dict(sa3=Layer(7.0, *SMALL.sa3[1:])), dict(plane=False), dict(max_range=9.0)]
    for i, change in enumerate(changes):
        assert len(load(replace(SMALL, **change))) == 5 + 2 * i
    assert len(load(replace(SMALL, fe=Layer(None, None, 3, (16, 32)), lr=5.0))) == 17  # unrelated

    file = min(first)  # of sequence 00
    good = file.read_bytes()
    for bad in (good[:-1], good[:200], b"", b"noise" * 40, pickle.dumps(Mischief())):
        file.write_bytes(bad)
        load()
        assert file.read_bytes() == good and not Path("mischief").exists()


def test_a_fingerprint_depends_on_the_scans_and_poses_and_not_on_names_or_times(cwd):
    def fingerprint(root):
        s, = kitti.open_sequences(root)
        return s.fingerprint(load_records([s], SMALL)[0]["crc"])

    shutil.rmtree("root/sequences/03")
    expected = fingerprint(shutil.copytree("root", "copy"))
    os.utime("copy/sequences/00/velodyne/000005.bin", (1, 1))
    os.rename("copy/sequences/00", "copy/sequences/new")
    os.rename("copy/poses/00.txt", "copy/poses/new.txt")
    assert fingerprint("copy") == expected
    prints, scans = {expected}, [f"{SCANS}/000004.bin", f"{SCANS}/000005.bin"]
    for change in (lambda: change_in_the_middle(scans[0]), put(scans[0], lambda x: x + x[:16]),
                   put(POSES, lambda text: b"\n".join(text.splitlines()[::-1])),
                   lambda: [os.rename(*names) for names in (
                       (scans[0], "x"), (scans[1], scans[0]), ("x", scans[1]))]):
        change()
        prints.add(fingerprint("root"))
    assert len(prints) == 5


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
    assert len(s) == len(s.poses) == 3
    assert_allclose(s.poses[0], np.eye(4), atol=1e-8)
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
def test_simulated_vehicles_drive_with_us_and_towards_us_and_never_into_us(name):
    world, u = kitti._world(name, 0, 170), np.linspace(-1, 1, 15)
    with_us = towards_us = 0
    for i, T in enumerate(world.T_flat):
        prisms = world.moving(i)
        x, y, yaw, half_x, half_y = prisms[:, :5].T[:, :, None, None]
        along, across = half_x * u[:, None], half_y * u  # points that cover the prism in plan
        x = x + along * np.cos(yaw) - across * np.sin(yaw) - T[0, 3]
        y = y + along * np.sin(yaw) + across * np.cos(yaw) - T[1, 3]
        ahead, left = x * T[0, 0] + y * T[1, 0], x * T[0, 1] + y * T[1, 1]
        assert not ((np.abs(ahead) < 2.4) & (np.abs(left) < 0.9)).any()  # our own car
        close = np.hypot(prisms[:, 0] - T[0, 3], prisms[:, 1] - T[1, 3]) < 30
        cosine = np.cos(prisms[close, 2] - np.arctan2(T[1, 0], T[0, 0]))
        with_us, towards_us = with_us + np.sum(cosine > 0.7), towards_us + np.sum(cosine < -0.7)
    assert with_us > 2 * 170 and towards_us > 0.6 * 170  # a vehicle is a body and a cabin


# ------------------------------------------------------------------------------------------------
# Raw drives


def move_and_link():
    shutil.move(DRIVE, "elsewhere")
    Path(DRIVE).symlink_to(Path("elsewhere").resolve())


def blank_lines(path, numbers):
    """A function that empties these lines of a file."""
    return put(path, lambda text: b"\n".join(b"" if i in numbers else line for i, line
                                             in enumerate(text.splitlines())))


def no_links(source, target):
    raise OSError("Invalid cross-device link")


@table("change, link, parts", {  # what to do to the drive, first and last scan of each sequence
    "whole": (lambda: None, os.link, [(0, 11)]), "a symbolic link": (move_and_link, os.link, [(0, 11)]),
    "no hard links": (lambda: None, no_links, [(0, 11)]),
    "scans": (delete(RAW_SCAN.format(3), RAW_SCAN.format(4)), os.link, [(0, 2), (5, 11)]),
    "a time": (blank_lines(SCAN_TIMES, [7]), os.link, [(0, 6), (8, 11)]),
    "packets": (delete(*map(PACKET.format, (4, 5, 6))), os.link, [(0, 4), (7, 11)]),
    "times of packets": (blank_lines(PACKET_TIMES, (4, 5, 6)), os.link, [(0, 4), (7, 11)])})
def test_a_raw_drive_is_converted_with_poses_at_the_times_of_its_scans_and_split_at_gaps(
        tmp_path, monkeypatch, capsys, change, link, parts):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(os, "link", link)
    truth, Tr = write_raw()
    change()
    assert run(f"raw {DRIVE} new") == 0
    (out, err), sequences, name = capsys.readouterr(), kitti.open_sequences("new"), DRIVE[11:-5]
    assert [s.name for s in sequences] == [name] * (len(parts) == 1) or [f"{name}-1", f"{name}-2"]
    assert ("split" in out) == (len(parts) > 1) and error_lines(err) == []
    for s, (first, last) in zip(sequences, parts, strict=True):
        metres = re.search(rf"{s.name}: scans {first} to {last}, (.*) m", out)[1]
        assert float(metres) == pytest.approx(1.2 * (last - first), abs=0.2)  # at 12 m/s
        expected = np.linalg.inv(truth[first]) @ truth[first:last + 1]
        assert_allclose(s.poses_cam, expected, atol=1e-3)  # 1 mm
        assert metrics.step_errors(expected, s.poses_cam).max() < 1e-3
        assert_allclose(s.Tr, Tr, atol=1e-9)
        assert_allclose(np.loadtxt(s.folder / "times.txt"), 0.1 * np.arange(len(s)), atol=0.01)
        for i, path in enumerate(s.scan_paths):
            scan = Path(DRIVE, f"velodyne_points/data/{first + i:010d}.bin")
            assert path.samefile(scan) == (link is os.link) and not path.is_symlink()
            assert path.read_bytes() == scan.read_bytes()
    refused(f"raw {DRIVE} new", "drive_0013.* already exists.*choose", capsys)


# ------------------------------------------------------------------------------------------------
# The command eval


def test_eval_writes_what_it_prints_and_agrees_with_the_metric(cwd, capsys):
    shutil.copytree("root/sequences/03", "root/sequences/11")  # without ground truth
    assert run(EVAL) == 0
    (out, err), results = capsys.readouterr(), read_json("out/results.json")
    sequences, splits = results["sequences"], results["splits"]
    assert list(results) == ["weights", "data", "refine", "sequences", "splits", "pooled", "lengths"]
    assert sorted(os.listdir("out")) == ["00.txt", "03.txt", "11.txt", "results.json"]
    assert list(sequences) == ["00", "03", "11"] and list(splits) == ["train", "test"]
    for name, s in [*sequences.items(), *splits.items(), ("all", results["pooled"])]:
        assert table_row(out, name) == as_printed(s) and s["trained_on"] is False
    assert sequences["11"]["E_t"] is None and error_lines(err) == [] and " *\n" not in out

    # Compute the trajectories from the scans, and the errors from the trajectories
    keys, segments, motion = ("E_t", "E_r", "t_step_m", "r_step_deg"), [], from_vector(MEAN_MOTION)
    for s, split in zip(kitti.open_sequences("root", ["00", "03"]), splits.values()):
        T = metrics.read_poses(f"out/{s.name}.txt")
        pairs = [relative_pose(s.scan(i), s.scan(i + 1), "w.pt") for i in range(14)]
        estimates = {"network": invert(s.Tr) @ T @ s.Tr, "standing still": [np.eye(4)] * 15,
                     "mean training motion": [np.linalg.matrix_power(motion, i) for i in range(15)]}
        assert_allclose(estimates["network"], d3dlo.accumulate(pairs), rtol=1e-3, atol=1e-3)
        for name, T_velo in estimates.items():
            errors = devkit_errors(s.poses_cam, s.Tr @ T_velo @ invert(s.Tr))
            expected = [*errors[:, 3:].mean(0), *metrics.step_errors(s.poses, T_velo).mean(0)]
            got = split if name == "network" else split[name]
            assert_allclose([got[key] for key in keys], expected, rtol=1e-5)
            segments += [*errors] * (name == "network")
        assert sequences[s.name]["E_t"] == split["E_t"]
    segments = np.array(segments)
    assert results["pooled"]["E_t"] == pytest.approx(segments[:, 3].mean())
    for length in np.unique(segments[:, 2]):
        expected = segments[segments[:, 2] == length, 3].mean()
        assert results["lengths"][f"{length:.0f} m"]["E_t"] == pytest.approx(expected)
    assert run("metrics root/poses out") == 0  # in the camera's frame: other errors per step
    assert table_row(capsys.readouterr().out, "03")[:3] == as_printed(sequences["03"])[:3]


@pytest.mark.parametrize("refine", [0, 2])
def test_eval_of_a_plain_folder_writes_its_trajectory_and_refines_as_often_as_asked(
        cwd, capsys, refine):
    Path("drive/times.txt").write_text("\n".join(f"{7 + i}" for i in range(12)))
    assert run(f"eval --data drive --weights w.pt --refine {refine} --out out") == 0
    out, err = capsys.readouterr()
    assert sorted(os.listdir("out")) == ["poses.tum", "poses.txt", "results.json"]
    poses, rows = metrics.read_poses("out/poses.txt"), np.loadtxt("out/poses.tum")
    odometry = d3dlo.Odometry("w.pt", refine=refine)
    expected = [odometry.register(np.load(f"drive/scan {i}.npy")) for i in range(1, 13)]
    assert_allclose(poses, expected, rtol=1e-3, atol=1e-3)
    assert_allclose(rows[:, :4], np.c_[7 + np.arange(12), poses[:, :3, 3]], atol=1e-6)
    path = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum()
    assert read_json("out/results.json") == {"weights": "w.pt", "data": "drive", "refine": refine,
                                             "scans": 12, "path_m": pytest.approx(path)}
    assert f"drive: 12 scans, path of {path:.1f} m" in out and error_lines(err) == []


def test_without_data_the_city_is_simulated_and_trained_on_with_the_short_recipe(cwd, monkeypatch):
    simulate, held_out = kitti.simulate, [*SPLITS["test"], *SPLITS["validation"]]
    monkeypatch.setattr(kitti, "simulate", lambda root, sequences: simulate(
        root, sequences=sequences, scans=2, azimuth=100))
    assert run("eval --weights w.pt --out out") == 0
    assert list(read_json("out/results.json")["sequences"]) == held_out
    assert set(os.listdir("data/simulated/sequences")) == set(held_out)
    assert run("train --weights w.pt --epochs 1 --out new") == 0
    made = read_json("new/config.json")
    assert made["config"] == replace(SMALL, **SHORT | {"epochs": 1}).as_dict()
    assert made["arguments"]["sequences"] == list(SPLITS["train"])
    assert list(read_json("new/results/results.json")["sequences"]) == held_out


# ------------------------------------------------------------------------------------------------
# The command train


def test_train_stores_a_run_that_eval_reads_and_marks_what_it_was_trained_on(cwd, capsys):
    assert run("train --data root --weights w.pt --epochs 2 --out new") == 0
    out, err = capsys.readouterr()
    assert error_lines(err) == [] and Path("new/log.txt").read_text() == out
    assert set(os.listdir("new")) == {
        "weights.pt", "checkpoint.pt", "config.json", "log.txt", "results"}
    assert re.findall(r"^epoch (\d)/2: loss [\d.]+, test loss [\d.]+, lear", out, re.M) == ["1", "2"]
    made = read_json("new/config.json")
    assert made["config"] == replace(SMALL, epochs=2, swap="random").as_dict()  # the paper's
    assert made["arguments"]["sequences"] == ["00"]
    assert made["versions"].keys() == {"commit", "d3dlo", "python", "numpy", "scipy", "torch"}
    motions = kitti.open_sequences("root", "00")[0].motions()
    assert_allclose(stored("new/weights.pt")["mean_motion"], to_vector(motions).mean(0), atol=1e-6)

    assert run("eval --data root --weights new --out out") == 0
    assert re.findall(r"^(\w+) \*", capsys.readouterr().out, re.M) == ["00", "train", "all"]
    before, after = read_json("new/results/results.json"), read_json("out/results.json")
    assert before["sequences"]["03"] == after["sequences"]["03"]

    # Training on other data from these weights remembers the first, and trains on all that is not
    # held out, since there are no sequences of the training split
    write_root("other", ["a", "b", "07"])
    assert run("train --data other --weights new --epochs 1 --out later") == 0
    assert read_json("later/config.json")["arguments"]["sequences"] == ["a", "b"]
    assert list(read_json("later/results/results.json")["sequences"]) == ["07"]
    for data, names in {"root": ["00", "train", "all"], "other": ["a", "b", "all"]}.items():
        capsys.readouterr()
        assert run(f"eval --data {data} --weights later --out {data}-out") == 0
        assert re.findall(r"^(\w+) \*", capsys.readouterr().out, re.M) == names

    change_in_the_middle(f"{SCANS}/000005.bin")
    refused("train --out new --resume", "data has changed.*resume it with", capsys)


def test_every_option_of_train_has_an_effect(cwd):
    def train(options):
        assert run(f"train --data root --out new {options}") == 0
        made = (Path("new/log.txt").read_text(), read_json("new/config.json")["config"],
                stored("new/weights.pt")["model"])
        shutil.rmtree("new")
        return made

    small = "--weights w.pt --epochs 1 "
    first, config, model = train(small)
    for option, words in {"--epochs 3": "epoch 3/3", "--batch 7": "epochs of 2 batches",
                          "--lr 0.25": "rate 2.5e-01", "--sequences 03": "pairs of .* 03"}.items():
        log = train(small + option)[0]
        assert re.search(words, log) and not re.search(words, first)
    assert train(small + "--short")[1] == replace(SMALL, **SHORT | {"epochs": 1}).as_dict()
    for option, same in {"--seed 0": True, "--seed 1": False}.items():
        other = train(small + option)[2]
        assert all(torch.equal(model[name], other[name]) for name in model) == same

    shutil.rmtree("root/sequences/03")
    for i in range(15):  # enough points for the network of Table 1
        random_scan(generator(i), 1200).tofile(f"{SCANS}/{i:06d}.bin")
    options = "--epochs 1 --batch 7 --neighbors 5 --no-plane --lr 1e-9 --seed "
    (_, config, model), (*_, other) = train(options + "0"), train(options + "1")
    assert config == Config(epochs=1, batch=7, lr=1e-9, plane=False,
                            sa1=Layer(1.0, 1024, 5, (4, 8, 16, 32))).as_dict()
    assert (model["mlp.0.weight"] - other["mlp.0.weight"]).abs().max() > 1e-3  # initial weights


LONG = "train --data root --weights w.pt --short --epochs 4 --batch 4 --out"


def train_until(action):
    """Train, and let something happen in the middle of writing the fourth checkpoint."""
    def save(content, file, save=torch.save, saved=[]):  # noqa: B006
        saved.append(file)
        if len(saved) == 4:
            file.write(b"half")
            file.flush()
            action()
        save(content, file)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch, "save", save)
        patch.setattr(d3dlo, "CHECKPOINT_EVERY", 0)
        patch.setattr(sys, "stdout", sys.stdout)  # to restore it
        return run(f"{LONG} new")


def kill():
    os.kill(os.getpid(), signal.SIGKILL)


def send_sigterm():
    signal.raise_signal(signal.SIGTERM)


def close_stdout():
    """As when `head` has read enough."""
    reader, writer = os.pipe()
    os.close(reader)
    sys.stdout = io.TextIOWrapper(io.FileIO(writer, "w"), write_through=True)


@table("action, code, line", {
    "kill -9": (kill, -signal.SIGKILL, None),
    "SIGTERM": (send_sigterm, 130, "interrupted; .* train --out new --resume"),
    "closed stdout": (close_stdout, 2, "standard output was closed; .* --resume")})
def test_an_interrupted_training_run_is_resumed_to_the_same_bits(cwd, capsys, action, code, line):
    assert run(f"{LONG} whole") == 0
    capsys.readouterr()
    if action is kill:
        script = f"import {__name__} as tests; tests.train_until(tests.kill)"
        environment = os.environ | {"PYTHONPATH": str(HERE)}
        got = subprocess.run([sys.executable, "-c", script], env=environment, timeout=60).returncode
    else:
        got = train_until(action)
    lines = error_lines(capsys.readouterr().err)
    assert got == code and (line is None or len(lines) == 1 and re.search(line, lines[0]))
    assert 0 < stored("new/checkpoint.pt")["step"] < stored("whole/checkpoint.pt")["step"]
    Path("new/results").mkdir()
    Path("new/results/old").write_text("of an earlier end")
    assert run("train --out new --resume") == 0
    assert sorted(os.listdir("new/results")) == ["03.txt", "results.json"]
    new, whole = stored("new/weights.pt")["model"], stored("whole/weights.pt")["model"]
    assert all(torch.equal(new[name], whole[name]) for name in whole)


def full(*arguments, **options):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@table("command, module, name, file", {
    "poses": (EVAL, np, "savetxt", "out/00.txt"), "weights": (TRAIN, torch, "save", "new/weights"),
    "json": (EVAL, Path, "write_text", "out/results.json"),
    "cache": (EVAL, np.lib.format, "write_array_header_1_0", "cache/00-")})
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
    assert run(f"{draw} a.png") == run(f"{draw} b.pdf") == run(f"{draw} c.svg") == 0
    assert run(f"{EVAL} --plot") == 0
    for name, start in {"a.png": b"\x89PNG", "b.pdf": b"%PDF", "c.svg": b"<?xml",
                        "out/plot.png": b"\x89PNG"}.items():
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
    for path, scan in write_folder("drive", "{}.bin", scale=255).items():
        np.c_[scan[:48], np.arange(48) % 32].astype(np.float32).tofile(path)


def change_weights(**changes):
    """A function that changes the content of w.pt. None removes a key."""
    return lambda: torch.save({key: value for key, value in (stored("w.pt") | changes).items()
                               if value is not None}, "w.pt")


def without_last_word(text):
    return text.rstrip().rpartition(b" ")[0]


def flip_a_bit(data):
    middle = len(data) // 2
    return data[:middle] + bytes([data[middle] ^ 1]) + data[middle + 1:]


# What the message must say, and what spoils good data
BAD_ROOTS = {
    "unpack.*ROOT/sequences/00/": delete("root/sequences"),
    "root has no scans.*unpack": delete("root/sequences/03", SCANS),
    "python kitti.py raw": lambda: os.rename("root/sequences", "root/2011_09_26_drive_0005_sync"),
    "velodyne .*000002.bin.* unpack": delete(f"{SCANS}/000002.bin"),
    "000003.bin.* bytes.*unpack it again": put(f"{SCANS}/000003.bin", lambda data: data[:-3]),
    "000003.bin has 0 bytes": put(f"{SCANS}/000003.bin", b""),
    "000003.bin is not a KITTI scan.*save": put(f"{SCANS}/000003.bin", b"\x93NUMPY0123456789"),
    "000003.bin: 30 usable.*metres": put(f"{SCANS}/000003.bin", lambda data: data[:16 * 30]),
    f"{POSES} has 14 poses.*unpack": put(POSES, lambda text: text.partition(b"\n")[2]),
    f"{POSES}, line 15: 11 words.*correct": put(POSES, without_last_word),
    f"{POSES}, line 16: 2 words": put(POSES, lambda text: text + b"frame 1"),
    f"{POSES}, line 15: 12": put(POSES, lambda text: without_last_word(text) + b" inf"),
    f"{POSES}: pose 1 .*must be": put(POSES, lambda text: text.replace(b"\n", b"\n9", 1)),
    f"{POSES}: pose 0 .*must be": put(POSES, lambda text: b"-" + text),  # a mirror
    f"{POSES}: holds no pose; give": put(POSES, "\n\n"),
    f"{POSES}.*UTF-16.*save": put(POSES, lambda text: text.decode().encode("utf-16")),
    f"{CALIB} does not exist.*write the line": delete(CALIB),
    f"{CALIB} has no row 'Tr'.*write": put(CALIB, lambda text: text.partition(b"Tr")[0]),
    f"{CALIB} has no row 'Tr'.*numbers": put(CALIB, without_last_word)}
BAD_FOLDERS = {
    r"1.bin: .*nuScenes.*reshape\(-1, 5\)": five_floats, "both.*move": put("drive/0.bin", "1" * 16),
    "scan 1.npy.* 300.*rescale": put("drive/scan 1.npy", np.full((9, 4), 300)),
    "scan 12.npy.* -0.5": put("drive/scan 12.npy", np.full((9, 4), -0.5)),
    r"scan 1.npy.*\(9, 5\).*save": put("drive/scan 1.npy", np.ones((9, 5))),
    r"scan 1.npy.*\(0, 4\).*save": put("drive/scan 1.npy", np.ones((0, 4))),
    "scan 1.npy.*numbers.*save": put("drive/scan 1.npy", np.full((9, 4), "x")),
    "scan 1.npy is damaged.*save": put("drive/scan 1.npy", "damaged"),
    "scan 1.npy is dam.*": put("drive/scan 1.npy", np.array([Mischief()])),
    "scan 1.npy.*save ": lambda: np.savez(open("drive/scan 1.npy", "wb"), np.ones((9, 4))),
    "times.txt must hold 12": put("drive/times.txt", "1 2 3"),
    "times.txt .*increasing.*correct": put("drive/times.txt", "1\n" * 12),
    "times.txt .*seconds.*correct": put("drive/times.txt", "2011-09-26 10:00\n" * 12)}
BAD_DRIVES = {
    "velodyne_points/timestamps.txt does.*_0013_sync.zip": delete(SCAN_TIMES),
    "oxts/timestamps.txt.*_0013_sync.zip": delete(PACKET_TIMES),
    "velodyne_points/data/0000000000.bin.*_sync.zip": delete(f"{DRIVE}/velodyne_points/data"),
    "oxts/data/0000000000.txt.*_sync.zip": delete(f"{DRIVE}/oxts/data"),
    "calib_imu_to_velo.txt.*_calib.zip": delete(f"{DATE}/calib_imu_to_velo.txt"),
    "calib_cam_to_cam.txt.*_calib.zip": delete(f"{DATE}/calib_cam_to_cam.txt"),
    "oxts/timestamps.txt is damaged.*unpack": put(PACKET_TIMES, "2011-09-26 13:10:51.1\n"),
    "points/timestamps.txt is damaged.*unpack": put(SCAN_TIMES, "noon\n" * 12),
    "within 0.1 s.*unpack": put(PACKET_TIMES, "2011-09-28 13:10:51.1\n" * 12),
    "0005.txt is damaged.*30.*unpack": put(PACKET.format(5), without_last_word),
    "0005.txt is dam.*": put(PACKET.format(5), lambda text: text.replace(b"77", b"nan", 1)),
    "0007.bin has 639 bytes": put(RAW_SCAN.format(7), lambda data: data[:-1]),
    "velo_to_cam.txt is damaged.*unpack": put(f"{DATE}/calib_velo_to_cam.txt", "T: 0 0 0"),
    "imu_to_velo.txt is damaged.*unpack": put(f"{DATE}/calib_imu_to_velo.txt", without_last_word)}
BAD_WEIGHTS = {
    "size mismatch": change_weights(config=Config().as_dict()),
    "epochs is 0": change_weights(config=SMALL.as_dict() | {"epochs": 0}),
    "config": change_weights(config=None), "model": change_weights(model=None),
    "seen": change_weights(seen=None), "damaged": change_weights(mean_motion=[math.nan] * 6),
    "checkpoint": change_weights(parts=[]), "safety": change_weights(model=Mischief()),
    "w.pt": put("w.pt", lambda data: pickle.dumps(Mischief(), protocol=2)), "": put("w.pt", ""),
    "as D3DLO weights": put("w.pt", flip_a_bit), "read": put("w.pt", lambda data: data[:-2000]),
    "cannot be read": lambda: torch.save([1.0], "w.pt"), "D3DLO": put("w.pt", "hello")}
CITY = "simulate city --sequences 07 --scans 2 --azimuth 100"
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
    "train --resume --out gone": "gone/config.json.*--out",
    "train --resume --out run --epochs 3": "--resume.*give only --out",
    "train --sequences 00 0O": "0O; available", "train --data drive": "drive has no ground truth",
    "train --data root --weights gone.pt": "gone.pt: no such file; give",
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
    "metrics root/poses clouds": "clouds.*give two", "metrics . . --plot a.jpg": "",
    f"metrics {POSES} root/poses/03.txt --plot {POSES}": "--plot.*give",
    "metrics root/poses root/poses --plot new.jpg": "--plot new.jpg.*give"}
CASES = [(command, spoil, message) for commands, cases in (
    ((EVAL, TRAIN), BAD_ROOTS), (["eval --data drive --weights w.pt"], BAD_FOLDERS),
    ([f"raw {DRIVE} new"], BAD_DRIVES)) for message, spoil in cases.items() for command in commands]
CASES += [(EVAL, spoil, f"w.pt: .*{message}.*give") for message, spoil in BAD_WEIGHTS.items()]
CASES += [(command, lambda: None, message) for command, message in BAD_ARGUMENTS.items()]


@pytest.mark.parametrize("command, spoil, message", CASES)
def test_bad_input_fails_with_one_line_that_names_it_and_writes_nothing(
        cwd, capsys, command, spoil, message):
    spoil()
    refused(command, message, capsys)
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
