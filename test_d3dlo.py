"""Tests of D3DLO.

Expected values come from brute force, SciPy, a definition written out, a closed form, or another
library. Where two ways through the code must agree, one of them is tested in this way.
"""
import argparse
import contextlib
import copy
import functools
import importlib.util
import itertools
import json
import math
import multiprocessing
import os
import pickle
import re
import runpy
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import warnings
import zlib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation
from torch.optim.swa_utils import update_bn
from torch.utils._pytree import tree_map

import d3dlo
import kitti
import metrics
from d3dlo import (
    D3DLO,
    SHORT,
    Config,
    Layer,
    load_records,
    load_weights,
    relative_pose,
    scan_records,
)
from kitti import SPLITS, from_vector, invert, to_vector

settings.register_profile(
    "d3dlo", deadline=None, derandomize=True, database=None, max_examples=25,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
settings.load_profile("d3dlo")
torch.set_num_threads(1)  # faster for networks this small, above all on a busy machine

HERE = Path(__file__).resolve().parent
SEED = st.integers(0, 2**32 - 1)
generator, inverse = np.random.default_rng, np.linalg.inv

# A network with every kind of layer and a hundredth of the work
SMALL = Config(sa1=Layer(2.0, 16, 4, (4, 8, 16)), fe=Layer(None, None, 6, (16, 24)),
               sa2=Layer(4.0, 8, 8, (32, 40)), sa3=Layer(8.0, 4, 4, (32, 36)),
               mpn=Layer(None, None, None, (32, 64)), mlp=Layer(None, None, None, (32, 6)),
               max_range=50.0)
# The paper's training, and one with everything that has a state: nine steps on `two_sequences`
PAPERS = replace(SMALL, epochs=3, batch=3)
OURS = replace(SMALL, epochs=3, batch=3, augment=True, optimizer="muon", schedule="one-cycle",
               frozen=4 / 9)
# What a weights file stores about its training data. These ranges fit any scan.
FACTS = dict(trained_on=[], mean_motion=[1.0, 0, 0, 0, 0, 0],
             seen=[[1.0, 0.0, 1.0, 0.01], [1e6, 1e3, 100.0, 1.0]])


def random_scan(rng, n):
    """A scan (n,4) in a flat box of 16 m."""
    xy, z = rng.uniform(-8, 8, (n, 2)), rng.uniform(-2, 2, n)
    return np.c_[xy, z, rng.random(n)].astype(np.float32)


def random_motion(rng, scale=(0.5, 0.2, 0.1, 0.5, 0.5, 2.0), n=None):
    """One rigid motion (4,4), or n of them (n,4,4); scale in metres and degrees."""
    return from_vector(rng.normal(size=6 if n is None else (n, 6)) * scale)


def transform(T, xyz):
    return xyz @ T[:3, :3].T + T[:3, 3]


def static_world(rng, motions, points=100):
    """Scans i of the same points k from poses `motions` apart. The intensity is i + 0.1 (k % 3)."""
    world, k = random_scan(rng, points)[:, :3].astype(float), np.arange(points)
    poses = itertools.accumulate(motions, np.matmul, initial=np.eye(4))
    return [np.c_[transform(inverse(T), world), i + k % 3 / 10].astype(np.float32)
            for i, T in enumerate(poses)]


def records_of(scans, config=SMALL):
    return np.concatenate([scan_records(scan, config) for scan in scans])


def pairs_of_scans(rng, n, points=64, config=SMALL):
    """n sequences of two scans, P and P moved, as `fit` takes them."""
    return [(records_of(static_world(rng, [T], points), config), T[None])
            for T in random_motion(rng, n=n)]


def two_sequences():
    """Two sequences of six unrelated scans, for tests where it does not matter what is learned."""
    rng = generator(0)
    return [(records_of(random_scan(rng, 48) for _ in range(6)), random_motion(rng, n=5))
            for _ in range(2)]


def random_batch(rng, config=SMALL, pairs=3):
    """A Batch and the motions of its pairs, as in training."""
    data = pairs_of_scans(rng, pairs, config.sa1.n_fps + 76, config)
    return d3dlo.training_batch(data, d3dlo.all_pairs(data), config, rng)


def random_net(rng, config=SMALL, network=D3DLO):
    """An untrained network in eval mode, with all kinds of BatchNorm scales and statistics."""
    torch.manual_seed(int(rng.integers(2**31)))
    net = network(config)
    for module in net.modules():
        if isinstance(module, torch.nn.BatchNorm1d):
            torch.nn.init.normal_(module.weight)
            torch.nn.init.normal_(module.bias)
    update_bn([random_batch(rng, config)], net)
    return net.eval()


def save_weights(path, net, **facts):
    """Write a weights file as `fit` does. Returns its path."""
    config = net.config.as_dict()
    d3dlo.save(path, config=config, model=net.state_dict(), step=0, **FACTS | facts)
    return path


def train(folder, config, checkpoint=None, network=D3DLO, data=None, every=1e9, **options):
    """Run `fit` to its end or Ctrl-C, storing files `every` so many seconds. Returns its lines."""
    lines = []
    torch.manual_seed(99 if checkpoint else 0)  # a resumed run must not depend on its first weights
    with pytest.MonkeyPatch.context() as patch, contextlib.suppress(KeyboardInterrupt):
        patch.setattr(d3dlo, "CHECKPOINT_EVERY", every)
        patch.setattr(d3dlo, "WEIGHTS_EVERY", every)
        d3dlo.fit(network(config), data or two_sequences(), folder, seed=7, say=lines.append,
                  checkpoint=checkpoint, **FACTS | options)
    return lines


def files_in(folder):
    """{name: content} of weights and checkpoints, tensors as lists."""
    return {path.name: tree_map(lambda x: x.tolist() if isinstance(x, torch.Tensor) else x,
                                torch.load(path)) for path in folder.glob("*.pt")}


EVAL = "eval --data root --weights w.pt --out out"
TRAIN = "train --data root --weights w.pt --epochs 1 --out new"
SCANS, POSES, CALIB = (f"root/{name}" for name in (
    "sequences/00/velodyne", "poses/00.txt", "sequences/00/calib.txt"))
DATE, DRIVE = "2011_09_26", "2011_09_26/2011_09_26_drive_0013_sync"
SCAN_TIMES, PACKET_TIMES, RAW_SCAN, PACKET = (f"{DRIVE}/{name}" for name in (
    "velodyne_points/timestamps.txt", "oxts/timestamps.txt",
    "velodyne_points/data/{:010d}.bin", "oxts/data/{:010d}.txt"))


def random_trajectory(rng, n, scale=(2.5, 0.3, 0.1, 0.3, 0.3, 3.0)):
    """Poses (n,4,4) of a drive forward that keeps turning the same way."""
    steps = np.abs(rng.normal(size=(n - 1, 6))) * scale * [1, *rng.choice([-1, 1], 5)]
    return d3dlo.accumulate(from_vector(steps))


def straight_path(n, step):
    """Poses (n,4,4) of a camera that moves along z, its viewing direction."""
    return d3dlo.accumulate([from_vector([0, 0, step, 0, 0, 0])] * (n - 1))


def numbers(array):
    return " ".join(map(repr, np.ravel(array).tolist()))


def write_root(root, names, seed=0):
    """Sequences of 15 random scans in KITTI's layout, about 8 m apart."""
    rng, Tr = generator(seed), from_vector([0.1, -0.2, 0.3, -90, 0, -90])
    for name in names:
        scans = Path(root, "sequences", name, "velodyne")
        scans.mkdir(parents=True)
        for i in range(15):
            random_scan(rng, 60).tofile(scans / f"{i:06d}.bin")
        scans.with_name("calib.txt").write_text(f"P0: 1 0 0\nTr: {numbers(Tr[:3])}\n")
        steps = [8, 0, 0, 0, 0, 0] + rng.normal(size=(14, 6)) * [0.3, 0.1, 0.1, 0.3, 0.3, 1]
        T = d3dlo.accumulate(from_vector(steps))
        metrics.write_poses(f"{root}/poses/{name}.txt", T)


def imu_pose(t):
    """T_wi (4,4) of the vehicle of `write_raw` after t seconds: 12 m/s on a climbing bend."""
    yaw = 0.4 + 0.3 * t  # on a circle of 40 m; x is east, y north, z up
    roll_pitch_yaw = np.degrees([0.03, 0.05, yaw])
    return from_vector([40 * np.sin(yaw), -40 * np.cos(yaw), 100 + 0.5 * t, *roll_pitch_yaw])


def write_raw():
    """Write a raw drive of 12 scans. Returns the true poses of the rectified camera, and Tr."""
    rng, packet = generator(0), np.full(30, 77.0)  # the value of all fields that are not used
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
        packet[:6] = 49 + lat, 8.4 + lon, up, 0.03, 0.05, yaw
        packet[[7, 6, 10]] = 12 * np.cos(yaw), 12 * np.sin(yaw), 0.5  # to the east, north and up
        packet[17:20] = T[:3, :3].T @ [0, 0, 0.3]  # along the vehicle's axes
        Path(PACKET.format(i)).write_text(numbers(packet))
    velo_imu, cam_velo, rectify = from_vector(
        [[0.8, -0.3, 0.5, 2, 5, 1], [0, -0.1, -0.3, -90, 1, -91], [0, 0, 0, 1, 2, 3]])
    for name, T in dict(imu_to_velo=velo_imu, velo_to_cam=cam_velo, cam_to_cam=rectify).items():
        R, t = numbers(T[:3, :3]), numbers(T[:3, 3])
        Path(DATE, f"calib_{name}.txt").write_text(f"R: {R}\nR_rect_00: {R}\nT: {t}\n")
    poses = [imu_pose(t) @ invert(rectify @ cam_velo @ velo_imu) for t in scan_times]
    return invert(poses[0]) @ poses, rectify @ cam_velo


@pytest.fixture(scope="session")
def original(tmp_path_factory):
    """A folder with data of all kinds, small weights and a training run. Read only."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder := tmp_path_factory.mktemp("original"))
        write_root("root", ("00", "03"))
        write_raw()
        for name in ("drive/0.pcd", "clouds/0.pcd", "five/0.bin"):
            Path(name).parent.mkdir()
            Path(name).write_bytes(bytes(20 * 51))  # 51 points of five float32
        for i in range(1, 13):
            np.save(f"drive/scan {i}.npy", random_scan(generator(i), 50))
        kitti.simulate("city", sequences=["07"], scans=2, azimuth=100)
        torch.manual_seed(2)
        net = d3dlo.D3DLO(SMALL)
        net.mlp[-1].weight.data *= 30  # so that the predictions depend visibly on the scans
        save_weights("w.pt", net, mean_motion=[10.0, 1, 0, 0, 0, 3],
                     seen=[[1, 0.1, 1, 0.01], [1e6, 1, 100, 1]])
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
    lines = err.replace(os.sep, "/").splitlines()
    return [line for line in lines if not re.search(r"^$|: \d+/\d+, .* left *$", line)]


def succeeds(command, capsys):
    """Assert that a command succeeds and warns of nothing. Returns what it prints."""
    capsys.readouterr()
    code, (out, err) = run(command), capsys.readouterr()
    assert code == 0 and error_lines(err) == []
    return out


def files_of(root):
    """{path: content} of everything below a folder but the cache; None for folders."""
    paths = [path for path in Path(root).rglob("*") if "cache" not in path.parts]
    return {str(path.relative_to(root)): path.read_bytes() if path.is_file() else None
            for path in paths}


def refused(command, pattern, capsys):
    """Assert that a command fails with one line on stderr, which matches, and writes nothing."""
    before, code, (out, err) = files_of("."), run(command), capsys.readouterr()
    line, = error_lines(err)
    assert code == 2 and re.search(pattern, line) and "Traceback" not in err + out, line
    assert files_of(".") == before


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
    def replacement(*arguments, function=getattr(module, name)):
        monkeypatch.setattr(module, name, function)
        action()
        return function(*arguments)

    monkeypatch.setattr(module, name, replacement)


class Mischief:
    """Makes a folder when it is unpickled, as a malicious file might run code."""

    def __reduce__(self):
        return os.mkdir, ("mischief",)


def put(path, content):
    """A function that writes bytes or an array to a file, or changes its bytes."""
    def change():
        data = content(Path(path).read_bytes()) if callable(content) else content
        if isinstance(data, np.ndarray):
            np.save(path, data)
        else:
            Path(path).write_bytes(data)

    return change


def delete(*paths):
    return lambda: [shutil.rmtree(path) if Path(path).is_dir() else os.remove(path)
                    for path in paths]


def flip(data):
    """Flip the sign of an x in the middle of a scan."""
    i = len(data) // 32 * 16 + 3
    return data[:i] + bytes([data[i] ^ 128]) + data[i + 1:]


# ------------------------------------------------------------------------------------------------
# Sampling and grouping

KINDS = st.sampled_from(["grid", "duplicates", "line", "one x", "far away", "float32", "float64"])


def random_points(rng, kind, N):
    """Points (N,3) of one of the KINDS, many of them with ties between distances."""
    xyz = rng.normal(size=(N, 3)) * [20, 20, 2]
    special = {"grid": rng.integers(-4, 5, (N, 3)), "line": xyz * [1, 0, 0],
               "one x": xyz * [0, 1, 1], "duplicates": xyz[rng.integers(max(N // 3, 1), size=N)],
               "far away": xyz / 100 + [1e6, 0, 0]}  # x is rounded to multiples of 6 cm
    return special.get(kind, xyz).astype("float64" if kind == "float64" else "float32")


def fps_by_definition(xyz, n):
    """The next centroid is the point farthest from its nearest one. Ties: the first by x."""
    order = sorted(range(len(xyz)), key=lambda i: xyz[i, 0])  # equal ones stay in order
    centroids, distances = [0], []
    while len(centroids) < n:
        x, y, z = (xyz[order] - xyz[centroids[-1]]).T
        distances.append(x * x + y * y + z * z)
        centroids.append(order[np.min(distances, 0).argmax()])
    return np.array(centroids)


@given(SEED, KINDS, st.integers(1, 80) | st.integers(80, 400))
@settings(max_examples=150)
def test_farthest_point_sampling_follows_the_definition_and_is_nested(seed, kind, N):
    xyz, n = random_points(generator(seed), kind, N), min(N, 100)
    got = d3dlo.farthest_point_sampling(xyz, n)
    assert_array_equal(got, fps_by_definition(xyz, n))
    assert_array_equal(d3dlo.farthest_point_sampling(xyz, n // 2 + 1), got[:n // 2 + 1])
    for n in (0, -1, N + 1):
        with pytest.raises(ValueError, match=f"{n} .*{N}"):
            d3dlo.farthest_point_sampling(xyz, n)


def nearest(xyz, query, k, r=np.inf, fill=None):
    """(S,k) indices by brute force: the k nearest points within r of each query, nearest first.
    Other places hold fill (S,), by default the nearest point.
    """
    rows = []
    for s, distance in enumerate(cdist(query.astype(float), xyz.astype(float))):
        row = [i for i in distance.argsort(kind="stable")[:k] if distance[i] <= r]
        rows.append(row + [row[0] if fill is None else fill[s]] * (k - len(row)))
    return np.array(rows)


@given(SEED, KINDS, st.integers(1, 12) | st.integers(1, 200), st.integers(1, 20),
       st.sampled_from([0.5, 1.0, 2.0, 5.0]))  # in the grid there are points at exactly r
@settings(max_examples=100)
def test_neighbours_equal_brute_force(seed, kind, N, k, r):
    def assert_same(query, got, expected, tolerance=1e-9):
        D = cdist(query.astype(float), xyz.astype(float))  # ties may be in any order
        a, b = np.take_along_axis(D, got, 1), np.take_along_axis(D, expected, 1)
        assert_allclose(a, b, rtol=tolerance, atol=tolerance)
        assert [len({*row}) for row in got.tolist()] == [len({*row}) for row in expected.tolist()]

    rng = generator(seed)
    xyz, query, idx = random_points(rng, kind, N), random_points(rng, kind, N), rng.permutation(N)
    ball, within = d3dlo.group_ball(xyz, idx, r, k), nearest(xyz, xyz[idx], k, r, np.full(N, -1))
    assert_same(xyz[idx], ball, np.where(within < 0, idx[:, None], within))
    assert (np.where(within < 0, ball, idx[:, None]) == idx[:, None]).all()  # the centroid fills up
    expected, clouds = nearest(xyz, query, k), torch.from_numpy(np.stack([query, xyz, query]))
    assert_same(query, d3dlo.group_knn(xyz, query, k), expected)
    elsewhere = type("Elsewhere", (torch.Tensor,), {"device": SimpleNamespace(type="not cpu")})
    for tensor in (clouds, clouds.as_subclass(elsewhere)):
        for got in d3dlo.neighbours_in_q(tensor, np.array([0, 2]), np.array([1, 1]), k).numpy():
            assert_same(query, got, expected, 1e-5)


@given(SEED, st.integers(1, 5), st.integers(16, 100))
def test_scan_records_samples_and_groups_the_usable_points(seed, n, points):
    rng = generator(seed)
    usable = random_scan(rng, points)
    junk = np.float32([[np.nan, 0, 0, 0], [0, np.inf, 0, 0], [1, 1, 1, np.nan], [1e30, 0, 0, 0],
                       [1001, 0, 0, 0], [1, 1, 1, 7e4], [0, 50.1, 0, 0]])  # the last one is valid
    scan = np.insert(usable, rng.integers(1, points, len(junk)), junk, axis=0)
    records, parts = scan_records(scan, SMALL, n), min(n, points // 16)
    for k, record in enumerate(records):
        start = k % parts  # with too few points some records are equal
        centroids = start + parts * fps_by_definition(usable[start::parts, :3], 16)
        xyz = usable[centroids, :3]
        neighbours = usable[nearest(usable[:, :3], xyz, 4, 2.0, centroids)]  # in the whole scan
        offsets = neighbours[..., :3] - xyz[:, None]
        z, distances = usable[:, 2], np.sqrt(np.square(xyz).sum(1))
        fullest = max(((z >= low) & (z < low + 0.3)).sum() for low in np.arange(-10, 10) * 0.3)
        facts = points, usable[:, 3].mean(), np.median(distances), fullest / points
        assert_array_equal(record["xyz"], xyz)
        assert_array_equal(record["group_sa1"], np.concatenate([neighbours[..., 3:], offsets], -1))
        assert_array_equal(record["idx_sa2"], nearest(xyz, xyz[:8], 8, 4.0, range(8)))
        assert_array_equal(record["idx_sa3"], nearest(xyz[:8], xyz[:4], 4, 8.0, range(4)))
        assert_allclose(record["stats"], facts, rtol=1e-4)
        assert record["invalid"] == 6
    centroids = np.concatenate(records["xyz"][:parts])
    assert len(records) == n and len(np.unique(centroids, axis=0)) == 16 * parts  # none shared
    with pytest.raises(ValueError, match="15 different usable points .* 50 m.* needs 16"):
        scan_records(np.concatenate([usable[:15], junk]), SMALL, n)


# ------------------------------------------------------------------------------------------------
# Motions and frames


def motion_by_definition(v):
    """x, y, z [m], roll, pitch, yaw [degrees] as a matrix (4,4), written out."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(np.radians(v[3:])), np.sin(np.radians(v[3:]))
    Rx = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    Ry = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    Rz = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return np.block([[Rz @ Ry @ Rx, np.array(v[:3])[:, None]], [np.zeros(3), 1]])


@given(SEED, st.lists(st.integers(0, 5), max_size=3),
       st.none() | st.sampled_from([0, 1e-12, 1e-9, 1e-7, 1e-5, 1e-3, 0.1]))
@settings(max_examples=100)
def test_vectors_are_extrinsic_xyz_and_survive_the_round_trip_and_gimbal_lock(seed, shape, off):
    rng = generator(seed)
    v = rng.uniform(-1, 1, (*shape, 6)) * [100, 100, 100, 179.9, 89, 179.9]
    if off is not None:
        v[..., 4] = rng.choice([-1, 1]) * (90 - off)
    T = from_vector(v)
    expected = [motion_by_definition(row) for row in v.reshape(-1, 6)]
    assert_allclose(T, np.reshape(expected, (*shape, 4, 4)), atol=1e-12)
    assert_allclose(kitti.invert(T), inverse(T), atol=1e-11)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert_allclose(from_vector(to_vector(T)), T, atol=1e-6)
    assert off is not None or np.abs(to_vector(T) - v).max(initial=0) < 1e-7
    # Change the frame, then move; or move, then change the frame
    Tr, q = random_motion(rng, [1, 1, 1, 90, 60, 90]), rng.normal(size=(4, 1))
    assert_allclose(kitti.velo_to_camera(T, Tr) @ Tr @ q, Tr @ T @ q, atol=1e-9)
    assert_allclose(kitti.camera_to_velo(kitti.velo_to_camera(T, Tr), Tr), T, atol=1e-9)


# ------------------------------------------------------------------------------------------------
# The network


def count(module):
    """Number of parameters to learn."""
    return sum(p.numel() for p in module.parameters() if p.requires_grad)


LAYER = Layer(1.0, 16, 4, (4, 8))


@pytest.mark.parametrize("name, value", [
    ("epochs", 0), ("epochs", 1.5), ("batch", True), ("lr", 0), ("lr", np.nan), ("lr", "1"),
    ("frozen", 1.0), ("frozen", -0.1), ("max_range", 0), ("optimizer", "sgd"),
    ("schedule", ""), ("plane", "yes"), ("r", LAYER._replace(r=-1.0)),
    ("n_fps", LAYER._replace(n_fps=10**6)), ("n_fps of sa2", LAYER._replace(n_fps=7)),
    ("n_n", LAYER._replace(n_n=0)), ("width", LAYER._replace(widths=(4, 10**6))),
    ("number of widths", LAYER._replace(widths=(4,))), ("last width of mlp", LAYER)])
def test_an_invalid_setting_is_refused_by_its_name(name, value):
    field = name if name in vars(SMALL) else "mlp" if "mlp" in name else "sa1"
    with pytest.raises(ValueError, match=f"^(the )?{name} (is|must be) "):
        replace(SMALL, **{field: value})


def test_the_default_is_table_1_with_61290_parameters_and_section_4():
    blocks = {"sa1": 868, "fe": 4480, "sa2": 8768, "sa3": 8768, "mpn": 21440, "mlp": 16966}
    net, layers = D3DLO(), [torch.nn.Linear, torch.nn.BatchNorm1d, torch.nn.ReLU]
    assert {name: count(block) for name, block in net.named_children()} == blocks
    assert count(net) == 61290
    for h in (net.sa1.mpn.h, net.fe.mpn.h, net.sa2.mpn.h, net.mpn.h, net.mlp[:3]):
        assert [type(layer) for layer in h] == layers * (len(h) // 3)
    paper = dict(sa1=[1.0, 1024, 8, [4, 8, 16, 32]], fe=[None, None, 16, [32, 64]],
                 sa2=[4.0, 256, 32, [64, 64]], sa3=[8.0, 64, 8, [64, 64]],
                 mpn=[None, None, None, [64, 256]], mlp=[None, None, None, [64, 6]],
                 max_range=None, plane=True, epochs=500, optimizer="adam", schedule="steps",
                 augment=False, frozen=0)
    assert Config().as_dict() == dict(batch=16, lr=1e-3) | paper  # it does not give these two
    assert {split: " ".join(names) for split, names in SPLITS.items()} == {
        "train": "00 01 02 08 09", "test": "03 04 05 06 10", "validation": "07"}
    adam, = d3dlo.make_optimizers(net, torch.nn.L1Loss())
    assert type(adam) is torch.optim.Adam
    assert adam.defaults == torch.optim.Adam([torch.zeros(1)]).defaults  # "with default values"


def by_the_equations(net, batch):
    """The predictions by eqs. 3 and 4 as they are printed, with loops over pairs and points."""
    xyz, P, Q = batch.xyz, batch.p.tolist(), batch.q.tolist()

    def maximum(mpn, groups):  # S lists of k vectors (c,) -> (S,c')
        z = torch.stack([torch.stack(tuple(group)) for group in groups])  # (S,k,c)
        return mpn.h(z.flatten(0, 1)).unflatten(0, z.shape[:2]).max(1).values

    def eq_3(sa, x, f, idx):
        groups = [[torch.cat([f[b][i], x[b][i] - x[b][j]]) for i in idx[b][j].tolist()]
                  for b in range(len(P)) for j in range(len(idx[b]))]
        return maximum(sa.mpn, groups).unflatten(0, (len(P), -1))

    def eq_4(fe, f):
        idx = [nearest(xyz[q].numpy(), xyz[p].numpy(), net.config.fe.n_n) for p, q in zip(P, Q)]
        groups = [[torch.cat([f[p][i], f[q][j], xyz[q][j] - xyz[p][i]]) for j in idx[b][i]]
                  for b, (p, q) in enumerate(zip(P, Q)) for i in range(len(idx[b]))]
        return maximum(fe.mpn, groups).unflatten(0, (len(P), -1))

    # The groups of the first set abstraction hold f_i and x_i - x'_j already
    f = maximum(net.sa1.mpn, batch.group_sa1.flatten(0, 1)).unflatten(0, (len(xyz), -1))
    e = eq_4(net.fe, f)
    e = eq_3(net.sa2, xyz[P], e, batch.idx_sa2[P])
    e = eq_3(net.sa3, xyz[P], e, batch.idx_sa3[P])
    return net.mlp(maximum(net.mpn, e))


@pytest.mark.parametrize("changes", [
    {}, dict(sa1=dict(n_n=1), fe=dict(n_n=1), sa2=dict(n_n=1)),
    dict(fe=dict(n_n=20), sa3=dict(n_n=12)),  # more neighbours than points
    dict(sa3=dict(r=0.1))])  # all neighbours are copies of the centroid, so every maximum is a tie
@pytest.mark.parametrize("training", [True, False])
@given(seed=SEED)
@settings(max_examples=3)
def test_predictions_gradients_and_statistics_follow_equations_3_and_4(training, changes, seed):
    layers = {name: getattr(SMALL, name)._replace(**change) for name, change in changes.items()}
    rng, config = generator(seed), replace(SMALL, **layers)
    net, batch = random_net(rng, config).double().train(training), random_batch(rng, config, 2)[0]
    batch = batch._replace(xyz=batch.xyz.double(), group_sa1=batch.group_sa1.double())
    literal = copy.deepcopy(net)
    got, expected = net(batch), by_the_equations(literal, batch)
    assert expected.std(0).min() > 1e-3  # predictions of different pairs differ
    torch.testing.assert_close(got, expected, rtol=1e-9, atol=1e-9)
    for y in (got, expected):
        (y * torch.arange(y.numel()).view(y.shape)).sum().backward()
    gradients = [{name: p.grad for name, p in n.named_parameters()} for n in (net, literal)]
    torch.testing.assert_close(*gradients, rtol=1e-6, atol=1e-7)
    torch.testing.assert_close(net.state_dict(), literal.state_dict(), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("training", [True, False])
def test_all_tensors_are_made_on_the_device_of_the_input(training):
    records, p, q = two_sequences()[0][0], np.array([0, 2, 5]), np.array([1, 3, 4])
    batch, net = d3dlo.make_batch(records, p, q, SMALL, "meta"), D3DLO(SMALL).to("meta")
    assert all(part.is_meta for part in batch) and batch.idx_fe.shape == (3, 16, 6)
    y_hat = net.train(training)(batch)  # PyTorch refuses to mix tensors of two devices
    d3dlo.loss_of(net, torch.nn.L1Loss(), batch, random_motion(generator(0), n=3)).backward()
    assert y_hat.shape == (3, 6) and y_hat.is_meta and net.sa1.mpn.h[0].weight.grad.is_meta


# ------------------------------------------------------------------------------------------------
# Training


@given(SEED, st.integers(2, 12))
def test_an_epoch_has_every_pair_once_with_the_motion_in_its_direction(seed, batch):
    config, data = replace(SMALL, batch=batch), two_sequences()
    scan_of = {record["xyz"].tobytes(): (s, i) for s, (records, _) in enumerate(data)
               for i, record in enumerate(records)}
    seen, forward, steps = [], [], d3dlo.steps_per_epoch(10, config)
    for b, T_pq in d3dlo.batches(data, config, (seed,), 0, 4 * steps):  # four epochs
        assert len(T_pq) >= min(batch, 10)  # no smaller batch at the end
        for p, q, T in zip(b.p, b.q, T_pq, strict=True):
            (s, i), (s_q, j) = (scan_of[b.xyz[c].numpy().tobytes()] for c in (p, q))
            assert s == s_q and abs(i - j) == 1
            motion = data[s][1][min(i, j)]
            assert_allclose(T, motion if i < j else inverse(motion), atol=1e-9)
            seen.append((s, min(i, j)))
            forward.append(i < j)
    for k in range(0, 40, 10):
        assert sorted(seen[k:k + 10]) == [(s, i) for s in range(2) for i in range(5)]
    assert len(seen) == 40 and 0 < sum(forward) < 40
    for size, pairs in ((1, 10), (batch, 1)):  # BatchNorm has no statistics for one row
        with pytest.raises(ValueError, match="at least 2"):
            d3dlo.steps_per_epoch(pairs, replace(config, batch=size))


def test_pairs_are_swapped_mirrored_aligned_and_moved_as_often_as_they_should():
    rng, mirror, seen = generator(0), np.diag([1, -1, 1, 1]), []
    metres = np.array([1.5, 0.5, 7, 1, 1, 2, 1])
    motions = from_vector(np.outer(metres, [1, 0, 0, 0, 0, 0]) + [0, 0, 0, 0, 0, 30])
    records = records_of(static_world(rng, motions))
    for _ in range(250):
        pairs = [(0, i) for i in range(7)]
        batch, T = d3dlo.training_batch([(records, motions)], pairs, OURS, rng)
        numbers = batch.group_sa1[:, 0, 0, 0].int().tolist()  # from the intensities
        assert_array_equal(batch.idx_sa2, records["idx_sa2"][numbers])
        points = torch.cat([batch.xyz[:, :, None], batch.group_sa1[..., 1:]], 2).numpy()
        points[:, :, 1:] += points[:, :, :1]  # centroids and their neighbours
        for p, q, T_pq in zip(batch.p.tolist(), batch.q.tolist(), T):
            assert_allclose(transform(T_pq, points[q]), points[p], atol=1e-3)
            assert np.linalg.det(T_pq[:3, :3]) > 0.999  # no reflection is left
            forward = p < q  # all P come before all Q
            (p, q), T_pq = sorted((p, q)), T_pq if forward else inverse(T_pq)
            i, j = numbers[p], numbers[q]
            side, = np.unique(np.sign(points[p, :, 0, 1] * records["xyz"][i, :, 1]))
            base = motions[i] if side > 0 else mirror @ motions[i] @ mirror
            aligned = abs(to_vector(T_pq)[5]) < 10  # all motions are turns of 30 degrees or more
            A = inverse(T_pq) @ (np.eye(4) if aligned else base)
            seen.append((i, j, aligned, side, forward, *to_vector(A)))
    i, j, aligned, side, forward, *A = np.transpose(seen)
    assert_allclose([aligned.mean(), side.mean(), forward.mean()], [1 / 3, 0, 1 / 2], atol=0.07)
    for chosen in (aligned == 1, aligned == 0):  # Q moves after it has been aligned
        assert_allclose(np.mean(A, 1, where=chosen), 0, atol=0.2)
        assert_allclose(np.std(A, 1, where=chosen), [0.25, 0.1, 0.03, 0.1, 0.1, 1], rtol=0.15)
    # The scan after P or, if the pair is aligned, any within 5 m
    within = {(a, b) for a in range(7) for b in range(a + 1, 8) if metres[a:b].sum() < 5}
    assert {*zip(i[aligned == 1], j[aligned == 1])} == within | {(a, a + 1) for a in range(7)}
    assert_array_equal((j - i)[aligned == 0], 1)


def test_the_network_can_overfit_sixteen_pairs(tmp_path):
    data = pairs_of_scans(generator(0), 16)
    config = replace(SMALL, epochs=200, lr=1e-2, schedule="one-cycle", frozen=0.25)
    *_, line = train(tmp_path, config, data=data)
    net, _ = load_weights(tmp_path)
    got = to_vector([d3dlo.predict_motions(net, records)[0] for records, _ in data])
    truth = to_vector([motions[0] for _, motions in data])
    assert np.abs(truth).mean() > 0.3 and np.abs(got - truth).mean() < 0.03
    assert float(re.search(r"loss (\S+),", line)[1]) < 0.03


def test_the_log_has_equation_2_and_rates_that_drop_at_epochs_300_and_400_of_500(tmp_path):
    config = replace(SMALL, epochs=10, batch=10, lr=0.002)  # one step an epoch
    lines = train(tmp_path, config)
    torch.manual_seed(0)
    batch, T = next(d3dlo.batches(two_sequences(), config, (7,), 0, 1))
    loss = np.abs(to_vector(T) - D3DLO(config)(batch).detach().numpy()).mean()
    assert lines[0] == f"epoch 1/10: loss {loss:.4f}, learning rate 2.0e-03"
    rates = ["2.0e-03"] * 6 + ["2.0e-04"] * 2 + ["2.0e-05"] * 2
    for i, (line, rate) in enumerate(zip(lines, rates, strict=True), 1):
        assert re.fullmatch(rf"epoch {i}/10: loss \d\.\d{{4}}, learning rate {rate}", line)


def interrupt(loss, y_hat):
    raise KeyboardInterrupt


class Loss(torch.nn.Module):
    """Eq. 2 with learned weights. One step, if given, is interrupted by event(loss, y_hat)."""

    def __init__(self, step=0, event=interrupt):
        super().__init__()
        self.weights = torch.nn.Parameter(torch.zeros(6))
        self.left, self.event = step, event

    def forward(self, y_hat, y):
        self.left -= y_hat.requires_grad  # the test loss has no gradient
        loss = ((y - y_hat).abs() * self.weights.exp()).mean()
        return self.event(loss, y_hat) if self.left == 0 else loss


@pytest.mark.parametrize("config", [OURS, PAPERS], ids=["ours", "the paper's"])
@pytest.mark.parametrize("step", [1, 2, 6, 9])  # OURS freezes the statistics after step 5
def test_an_interrupted_run_is_resumed_to_the_same_bits(tmp_path, config, step):
    whole, part, test = tmp_path / "whole", tmp_path / "part", pairs_of_scans(generator(1), 9)
    lines = train(whole, config, objective=Loss())
    said = train(part, config, objective=Loss(step), test=test, every=0)  # up to Ctrl-C
    assert [file["step"] for file in files_in(part).values()] == [step - 1] * 2 * (step > 1)
    for finished in (False, True):
        checkpoint = torch.load(part / "checkpoint.pt") if step > 1 or finished else None
        said += train(part, config, checkpoint, objective=Loss(), test=test, every=0)
        same = files_in(part) == files_in(whole)
        assert same
    # Both optimizers take every step at its own rate
    assert all(part["last_epoch"] == 9 for part in checkpoint["parts"] if "last_epoch" in part)
    torch.manual_seed(0)
    first, last = D3DLO(config).state_dict(), checkpoint["parts"][0]
    assert not any(torch.equal(first[name], last[name]) for name in first if "weight" in name)
    # The test loss is logged and has no other effect
    assert [re.sub(r", test loss \d\.\d{4}", "", line) for line in said] == lines
    net, _ = load_weights(part)
    errors = [to_vector(d3dlo.predict_motions(net, records)) - to_vector(T) for records, T in test]
    loss = (np.abs(errors) * checkpoint["parts"][1]["weights"].exp().numpy()).mean()
    assert f", test loss {loss:.4f}" in said[-1]


def test_an_interruption_leaves_the_previous_file(tmp_path, monkeypatch):
    d3dlo.save(tmp_path / "weights.pt", step=1)
    def half(path, data, write=Path.write_bytes):
        write(path, data[:9])
        full()

    monkeypatch.setattr(Path, "write_bytes", half)
    with pytest.raises(OSError, match="weights.pt.*No space"):
        d3dlo.save(tmp_path / "weights.pt", step=2)
    assert files_in(tmp_path) == {"weights.pt": {"step": 1}}


@pytest.mark.parametrize("seconds, weights, checkpoints", [(40, 2, 5), (110, 3, 9)])
def test_checkpoints_are_stored_every_minute_and_weights_every_five(
        tmp_path, monkeypatch, seconds, weights, checkpoints):
    saved, clock = [], SimpleNamespace(monotonic=itertools.count(0, seconds).__next__)
    monkeypatch.setattr(d3dlo, "time", clock)  # nine steps, each as long as given
    monkeypatch.setattr(d3dlo, "save", lambda path, **content: saved.append(path.stem))
    d3dlo.fit(D3DLO(PAPERS), two_sequences(), tmp_path, say=lambda line: None, **FACTS)
    assert (saved.count("weights"), saved.count("checkpoint")) == (weights, checkpoints)


@given(step=st.integers(1, 9), tested=st.booleans(), every=st.sampled_from([0, 60]),
       event=st.sampled_from([lambda loss, y_hat: loss * np.nan,  # or its gradient is NaN
                              lambda loss, y_hat: loss + (0 * y_hat).sum().sqrt()]))
@settings(max_examples=12)
def test_a_run_that_diverges_says_so_and_keeps_the_last_good_files(
        tmp_path_factory, step, tested, every, event):
    folder, test = tmp_path_factory.mktemp("run"), two_sequences() if tested else ()
    with pytest.raises(ValueError, match=r"\A\S+: [^\n]* non-finite at step [^\n]*\Z"):
        train(folder, PAPERS, objective=Loss(step, event), test=test, every=every)
    files = files_in(folder)
    assert len(files) == 2 * (step > 1 and every == 0)
    for content in files.values():
        assert content["step"] == step - 1 and not re.search("nan|inf", repr(content))


def test_statistics_are_recomputed_for_each_weights_file_until_they_are_frozen(
        tmp_path, monkeypatch):
    # Each batch holds all ten pairs, never swapped, so all batches have the same statistics
    load = d3dlo.training_batch
    monkeypatch.setattr(d3dlo, "training_batch", lambda data, pairs, config, rng, device: load(
        data, pairs, config, None, device))
    config, data = replace(SMALL, epochs=6, batch=10, lr=1e-2, frozen=0.5), two_sequences()
    train(tmp_path / "whole", config, objective=Loss())
    train(tmp_path / "half", config, objective=Loss(4), every=0)
    last, half = (torch.load(tmp_path / run / "weights.pt")["model"] for run in ("whole", "half"))
    net, lagging = D3DLO(config), torch.load(tmp_path / "half" / "checkpoint.pt")["parts"][0]
    net.load_state_dict(lagging)
    update_bn([load(data, d3dlo.all_pairs(data), config)], net)
    for name in [name for name in half if "running" in name]:
        torch.testing.assert_close(half[name], net.state_dict()[name], rtol=1e-3, atol=1e-3)
        assert torch.equal(half[name], last[name]) and not torch.equal(half[name], lagging[name])
    assert not torch.equal(half["mlp.0.weight"], last["mlp.0.weight"])


def test_weights_of_a_gpu_are_read_without_one(tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(torch.serialization, "location_tag", lambda storage: "cuda:0")
        path = save_weights(tmp_path / "w.pt", D3DLO(SMALL))
    assert not any(x.is_cuda for x in load_weights(path)[0].parameters())


def test_muon_trains_the_hidden_matrices_with_steps_as_large_as_adams():
    net, objective = D3DLO(replace(SMALL, optimizer="muon")), Loss()
    adam, muon = d3dlo.make_optimizers(net, objective)
    matrices = [m.weight for m in net.modules() if isinstance(m, torch.nn.Linear)][:-1]
    others = {*net.parameters(), *objective.parameters()} - {*matrices}
    assert {*muon.param_groups[0]["params"]} == {*matrices}
    assert {*adam.param_groups[0]["params"]} == others
    W, weight_decay = net.mpn.h[0].weight, muon.param_groups[0]["weight_decay"]
    before, W.grad = W.detach().clone(), torch.randn_like(W)
    muon.step()
    size = (W - before).square().mean().sqrt() / net.config.lr
    assert weight_decay == 0 and 0.1 < size < 0.3  # Adam's is about 0.2


@given(st.integers(1, 800), st.integers(1, 800))
@settings(max_examples=5)
def test_the_test_loss_uses_at_most_500_pairs_spread_over_all_sequences(n, m):
    numbers, records = [], np.zeros(n + m + 2, d3dlo.record_dtype(SMALL))
    motions = from_vector(np.arange(1, n + m + 1)[:, None] * [1, 0, 0, 0, 0, 0])

    def remember(y_hat, y):  # y is the number of the pair
        numbers.extend(y[:, 0].round().int().tolist())
        return y.sum()

    data = [(records[:n + 1], motions[:n]), (records[n + 1:], motions[n:])]
    d3dlo.held_out_loss(D3DLO(OURS).eval(), remember, data, "cpu")  # not augmented
    assert len({*numbers}) == len(numbers) == min(500, n + m)
    assert numbers[0] == 1 and numbers[-1] == n + m
    assert np.ptp(np.diff(numbers)) <= 1  # evenly spread


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


@pytest.mark.parametrize("drive", [
    random_trajectory, lambda rng, n: straight_path(n, 2.5)])  # 100 m are exactly 40 frames
@given(seed=SEED, n=st.integers(2, 450), size=st.sampled_from([0, 1e-5, 0.02, 20]))
def test_segment_errors_equal_the_devkits_and_step_errors_are_those_added(drive, seed, n, size):
    rng = generator(seed)
    T_gt, E = drive(rng, n), from_vector(size * rng.normal(size=(n - 1, 6)))
    start = from_vector(rng.normal(size=6) * [50, 50, 50, 90, 60, 90])  # must not matter
    T_est = start @ d3dlo.accumulate(np.linalg.inv(T_gt[:-1]) @ T_gt[1:] @ E)

    expected, got = devkit_errors(T_gt, T_est), metrics.segment_errors(T_gt, T_est)
    for field, column in zip(got.dtype.names, expected.T, strict=True):
        assert_allclose(got[field], column, rtol=1e-6, atol=1e-6)
    # E_t and E_r are means over the segments of all sequences
    pooled = np.r_[expected, expected[:3]][:, 3:]
    means = pooled.mean(0) if len(pooled) else [np.nan, np.nan]
    assert_allclose(metrics.kitti_errors([got, got[:3]]), means, rtol=1e-6, atol=1e-6)

    t = np.linalg.norm(E[:, :3, 3], axis=1)
    r = np.degrees(Rotation.from_matrix(E[:, :3, :3]).magnitude())
    assert_allclose(metrics.step_errors(T_gt, T_est), np.stack([t, r], 1), atol=1e-9)
    # The absolute error compares from a common first pose
    gaps = [np.linalg.inv(T[0]) @ T for T in (T_gt, T_est)]
    squares = [x * x + y * y + z * z for x, y, z in (gaps[0] - gaps[1])[:, :3, 3]]
    assert metrics.absolute_error(T_gt, T_est) == pytest.approx(math.sqrt(sum(squares) / n))
    for error in (metrics.segment_errors, metrics.step_errors, metrics.absolute_error):
        with pytest.raises(ValueError, match=f"{n + 1}.*{n}"):
            error(straight_path(n + 1, 1), T_est)


def test_metrics_prints_the_errors_of_files_and_folders(cwd, capsys):
    gt, est = straight_path(300, 1.0), straight_path(300, 1.01)
    for name, T in {"gt/03": gt, "gt/07": gt[:200], "est/03": est, "est/07": gt[:200]}.items():
        metrics.write_poses(f"{name}.txt", T)
        assert_allclose(np.loadtxt(f"{name}.txt"), T[:, :3].reshape(-1, 12), rtol=1e-9)
        put(f"{name}.txt", lambda text: b"\xef\xbb\xbf" + text)()  # a byte order mark is allowed
    E_t, ate = devkit_errors(gt, est)[:, 3], 0.01 * math.sqrt(sum(i * i for i in range(300)) / 300)
    expected = [len(E_t), E_t.mean(), 0, 0.01, 0, ate, 0.01, 0]
    for names in ("gt/03.txt est/03.txt", "gt est"):
        out = succeeds(f"metrics {names}", capsys)
        assert_allclose(figures(out, "03"), expected, atol=6e-4)
    for length in (100, 200):
        rows = [errors[errors[:, 2] == length, 3] for errors in (
            devkit_errors(gt, est), devkit_errors(gt[:200], gt[:200]))]
        expected = [len(np.concatenate(rows)), np.concatenate(rows).mean()]
        assert_allclose(figures(out, f"{length} m")[:2], expected, atol=6e-4)
    pooled = np.r_[E_t, devkit_errors(gt[:200], gt[:200])[:, 3]]
    assert_allclose(figures(out, "all")[:2], [len(pooled), pooled.mean()], atol=6e-4)


@given(SEED, st.sampled_from([-1, 1]))
def test_the_view_from_above_is_the_same_for_camera_and_lidar_poses(seed, gear):
    lidar = random_trajectory(generator(seed), 50, [gear, 0.05, 0.05, 1, 1, 6])  # or in reverse
    axes = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])  # the camera's
    for T, labels in ((lidar, ("LiDAR -y, right [m]", "LiDAR x, forward [m]")),
                      (axes @ lidar @ axes.T, ("camera x, right [m]", "camera z, forward [m]"))):
        view, *got = metrics.view_from_above(T)
        assert_allclose(view @ T[:, :3, 3].T, [-lidar[:, 1, 3], lidar[:, 0, 3]], atol=1e-9)
        assert tuple(got) == labels


# ------------------------------------------------------------------------------------------------
# The data


@given(SEED, st.floats(-8, 8), st.floats(-8, 8))
def test_points_within_15_cm_of_the_ground_are_removed_and_nothing_else(seed, roll, pitch):
    rng = generator(seed)
    heights = np.r_[rng.normal(0, 0.02, 3000), [-0.12, 0.12] * 20, [-0.18, 0.18] * 20,
                    rng.uniform(0.4, 3, 1500)]
    scan = np.c_[rng.uniform(-20, 20, (4580, 2)), heights, np.ones(4580)]
    scan = scan @ from_vector([0, 0, -1.7, roll, pitch, 0]).T  # the ones become intensities
    order = rng.permutation(4582)
    scan = np.r_[scan, np.full((2, 4), np.nan)].astype(np.float32)[order]
    assert_array_equal(kitti.remove_plane(scan, seed=seed), scan[order >= 3040])
    points, invalid = kitti.usable_points(scan, plane=False)
    assert_array_equal(points, scan[(order >= 3040) & (order < 4580)])
    assert scan_records(scan, replace(SMALL, plane=False))["stats"][0, 0] == len(points)
    assert invalid == 2
    for N, thick in ((500, 0), (5000, 0.1), (2, 0), (0, 0)):  # walls, and too few points
        wall = generator(0).uniform(-9, 9, (N, 3)) * [thick, 1, 1]
        assert_array_equal(kitti.remove_plane(wall), wall)


@pytest.mark.parametrize("name, scale, columns, removed, divisor, note", [
    ("{}.pcd.bin", 1, 4, (), 1, ""), ("no-{}-of-12.npy", 1, 4, (), 1, ""),
    ("{}.npy", 255, 4, (), 255, "by 255"), ("{}.npy", 2, 4, (), 255, "by 255"),
    ("{}.npy", 1, 3, (), 1, "no intensities"), ("{}.npy", 0, 4, (), 1, "no intensities"),
    ("{:06d}.npy", 1, 4, (4, 5, 9), 1, "3 scans are missing by the file names, the first after "
                                          "000003.npy"),
    ("{}00000.npy", 1, 4, (4, 5), 1, "2 scans are missing"),
    ("{:06d}.npy", 1, 4, (1, 2, 12), 1, ""), ("{:06d}.npy", 1, 4, range(2, 12, 2), 1, "")])
def test_a_folder_of_scans_is_one_sequence_in_natural_order(
        tmp_path, name, scale, columns, removed, divisor, note):
    scans = []
    for i in sorted({*range(1, 13)} - {*removed}):
        scan = random_scan(generator(i), 50) * np.float32([1, 1, 1, scale])
        put(tmp_path / name.format(i), scan[:, :columns] if "npy" in name else scan.tobytes())()
        scans.append(scan / np.float32([1, 1, 1, divisor]) * [1, 1, 1, columns == 4])
    (tmp_path / "._1.bin").write_text("left by another system")
    s, = kitti.open_sequences(tmp_path)
    assert kitti.sequence_names(tmp_path) == [s.name] == [tmp_path.name] and s.poses is None
    for i, scan in enumerate(scans):  # 2 comes before 10
        assert_array_equal(s.scan(i), scan)
    assert len(s) == len(scans) and note in "".join(s.notes) and len(s.notes) == 1 + bool(note)
    assert "10 scans a second" in s.notes[-1] and np.allclose(s.times, np.arange(len(s)) / 10)


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
    path = Path("root/sequences/03/velodyne/000002.bin")
    stat = path.stat()
    put(path, flip)()
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))  # like `rsync -t`
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
        put(file, bad)()
        load()
        assert file.read_bytes() == good and not Path("mischief").exists()


def test_the_city_is_the_same_with_any_workers_and_existing_sequences_are_kept(cwd):
    def simulate(to, names, **more):
        return files_of(kitti.simulate(to, sequences=names, scans=9, azimuth=200, **more))

    made = simulate("one", ("00", "07"), workers=1)
    assert simulate("two", ("07", "00"), workers=2) == made
    for name, data in simulate("other", ("07",), seed=1).items():
        assert not name.endswith((".bin", "07.txt")) or data != made[name]
    scan = "sequences/00/velodyne/000005.bin"
    Path("two", scan).write_bytes(b"there")
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


@pytest.mark.parametrize("change, parts", [  # the first and last scan of each sequence
    (lambda: None, [(0, 11)]),
    (lambda: Path(DRIVE).symlink_to(Path(DRIVE).rename("elsewhere").resolve()), [(0, 11)]),
    (delete(*map(RAW_SCAN.format, (3, 4))), [(0, 2), (5, 11)]),
    (put(SCAN_TIMES, lambda text: re.sub(rb"((.*\n){7}).*", rb"\1", text)), [(0, 6), (8, 11)]),
    (delete(*map(PACKET.format, (4, 5, 6))), [(0, 4), (7, 11)])])
@pytest.mark.parametrize("linked", [True, False])
def test_a_raw_drive_is_converted_with_poses_at_the_times_of_its_scans_and_split_at_gaps(
        tmp_path, monkeypatch, capsys, change, parts, linked):
    monkeypatch.chdir(tmp_path)
    truth, Tr = write_raw()
    change()
    if not linked:
        monkeypatch.setattr(os, "link", full)
    out, sequences = succeeds(f"raw {DRIVE} new", capsys), kitti.open_sequences("new")
    assert "".join(s.name[21:] for s in sequences) == ("-1-2" if "split" in out else "")
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


@pytest.mark.parametrize("name", ["01", "05", "06"])
def test_simulated_vehicles_drive_beside_us_and_never_into_us(name):
    world, near = kitti._world(name, 0, 170), 0
    for i, T in enumerate(world.T_flat):
        x, y, yaw, half_x, half_y = world.moving(i)[:, :5].T  # bodies and cabins
        x, y = T[0, 3] - x, T[1, 3] - y  # from them to us
        ahead = np.abs(x * np.cos(yaw) + y * np.sin(yaw)) - half_x
        aside = np.abs(y * np.cos(yaw) - x * np.sin(yaw)) - half_y
        gap = np.hypot(np.maximum(ahead, 0), np.maximum(aside, 0))
        assert gap.min() > 0.9  # half the width of our own car
        near += (gap < 30).sum()
    assert near > 4 * 170


UNGUARDED = """
import multiprocessing, d3dlo, kitti
multiprocessing.set_start_method("spawn", force=True)
d3dlo.load_records(kitti.open_sequences("root"), d3dlo.Config())
"""


def test_a_script_without_a_main_guard_gets_an_error_that_explains_it(cwd):
    Path("script.py").write_text(UNGUARDED)
    ran = subprocess.run([sys.executable, "script.py"], timeout=60, capture_output=True, text=True,
                         env=os.environ | {"PYTHONPATH": str(HERE)})
    assert re.match("OSError: a worker process died.* needs the line if __name__ == '__main__':",
                    ran.stderr.splitlines()[-1])


def test_pictures_are_drawn_if_matplotlib_is_installed(cwd, monkeypatch, capsys):
    with monkeypatch.context() as patch:  # as if matplotlib were not installed
        patch.setitem(sys.modules, "matplotlib.figure", None)
        for command in (f"{PLOT} a.png", f"{EVAL} --plot"):
            refused(command, "matplotlib.*pip install", capsys)
        assert not Path("cache").exists()  # refused before the work
    pytest.importorskip("matplotlib")
    assert run(f"{EVAL} --plot") == run(f"{PLOT} a.pdf") == run(f"{PLOT} a.svg") == 0
    for name, start in (("out/plot.png", b"\x89PNG"), ("a.pdf", b"%PDF"), ("a.svg", b"<?xml")):
        assert Path(name).read_bytes().startswith(start)


def test_a_fingerprint_depends_on_the_scans_and_poses_and_not_on_names(cwd):
    os.rename("root/sequences/03", "new")
    a, same, other = (kitti.Sequence(folder, Path(f"root/poses/{name}.txt")) for folder, name in (
        ("root/sequences/00", "00"), ("new", "00"), ("new", "03")))
    crcs = np.arange(15, dtype=np.uint32)
    assert a.fingerprint(crcs) == same.fingerprint(crcs) and a.name != same.name
    assert len({a.fingerprint(crcs), other.fingerprint(crcs), a.fingerprint(crcs[::-1])}) == 3


def test_the_version_is_printed(capsys):
    with pytest.raises(SystemExit, match="^0$"):
        run("--version")
    assert capsys.readouterr().out == f"d3dlo {d3dlo.__version__}\n"


# ------------------------------------------------------------------------------------------------
# Odometry and refinement


@given(SEED)
@settings(max_examples=8)
def test_odometry_multiplies_relative_poses_and_a_refused_scan_changes_nothing(tmp_path, seed):
    rng = generator(seed)
    net, scans, expected = random_net(rng), [random_scan(rng, 60) for _ in range(5)], np.eye(4)
    odometry = d3dlo.Odometry(path := save_weights(tmp_path / "w.pt", net))
    for i, scan in enumerate(scans):
        huge_intensity = scan * np.float32([1, 1, 1, 3e38])
        for bad in (scan[:, :3], scan[0], scan[:10], scan * np.nan, scan + 99, huge_intensity):
            with pytest.raises(ValueError):
                odometry.register(bad)
        if i:
            expected = expected @ d3dlo.relative_pose(scans[i - 1], scan, path)
        pose = odometry.register(scan)
        assert_allclose(pose, expected, atol=1e-9)
        pose[:] = 0  # it is a copy, so the next pose is not affected
    together = d3dlo.predict_motions(net, records_of(scans), batch=3)
    assert_allclose(functools.reduce(np.matmul, together), expected, atol=1e-3)
    for refine in (-1, 1.5, "1", None, float("nan"), True, 101):
        with pytest.raises(ValueError, match="refine"):
            d3dlo.relative_pose(scans[0], scans[1], path, refine)
    odometry.restart()
    assert_array_equal(odometry.register(scans[2]), np.eye(4))
    assert_allclose(odometry.register(scans[3]), together[2], atol=1e-3)


class Oracle(torch.nn.Module):
    """A network that knows the motions in a `static_world`, with errors that refinement removes."""

    decode, asked = staticmethod(from_vector), []

    def __init__(self, config):
        super().__init__()
        self.config = config

    def forward(self, batch):
        motions = []
        for p, q in zip(batch.p, batch.q):
            i, j = batch.group_sa1[[p, q], 0, 0, 0].tolist()  # numbers of scans and samplings
            x, y = batch.xyz[p].double(), batch.xyz[q].double()
            R, _ = Rotation.align_vectors(x - x.mean(0), y - y.mean(0))
            T = from_vector([*x.mean(0) - R.apply(y.mean(0)), *R.as_euler("xyz", degrees=True)])
            # The mean of both directions is right but for z; that of three samplings in z, too
            error = np.array([0.1, 0.1, [0.2, -0.1, -0.1][round(j * 10) % 10], 0, 0, 1])
            if T[0, 3] > 0.6:  # Q is not aligned
                T = T @ from_vector([0.3, 0.1, 0, 0, 0, 1])
            elif i < j:
                T = T @ from_vector(error)
            else:
                T = inverse(inverse(T) @ from_vector(error * [-1, -1, 1, 0, 0, -1]))
            self.asked.append((i, j))
            motions.append(T)
        return torch.from_numpy(to_vector(motions)).float()


@pytest.mark.filterwarnings("ignore")
@given(SEED, st.sampled_from([0, 9]))
@settings(max_examples=5)
def test_refining_averages_passes_against_a_keyframe_and_the_last_scan(tmp_path, seed, yaw):
    rng, keyframe, expected = generator(seed), 0, []
    motions = random_motion(rng, [0.1, 0.1, 0.1, 0, 0, 1], n=30) @ from_vector([1, 0, 0, 0, 0, yaw])
    path = save_weights(tmp_path / "w.pt", Oracle(SMALL))
    odometry, truth = d3dlo.Odometry(path, refine=3, network=Oracle), [np.eye(4)]
    Oracle.asked.clear()
    for i, scan in enumerate(static_world(rng, motions)):
        with pytest.raises(ValueError):
            odometry.register(scan[:10])  # changes nothing
        if i:
            truth.append(truth[-1] @ motions[i - 1])
            expected.append((i - 1, i))
            for k, p in zip((0, 0.1, 0.2), (keyframe, i - 1, i - 1)):
                expected += [(p + k, i + k), (i + k, p + k)]
        pose = odometry.register(scan)
        assert_allclose(pose, truth[i], atol=1e-3)
        T = inverse(truth[keyframe]) @ truth[i]
        angle = np.degrees(np.arccos(np.clip((np.trace(T[:3, :3]) - 1) / 2, -1, 1)))
        if np.linalg.norm(T[:3, 3]) >= 5 or angle >= 20:
            keyframe = i
    assert_allclose(Oracle.asked, expected, atol=0.01)
    assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)  # rigid


@pytest.mark.filterwarnings("ignore")
def test_degenerate_scenes_give_a_rigid_motion(tmp_path):
    rng, path = generator(0), save_weights(tmp_path / "w.pt", random_net(generator(0), Config()))
    field, (x, z) = rng.uniform(-50, 50, (5000, 4)), rng.uniform(-1, 1, (2, 5000))
    field[:, 2:] = -1.73, 0.3
    corridor = np.c_[80 * x, rng.choice([-2, 2], 5000), z, np.full(5000, 0.3)]
    for p in (field, corridor, random_scan(rng, 1024)):
        for q, refine in itertools.product((p, p * [-1, -1, 1, 1]), (0, np.int64(1))):
            T = d3dlo.relative_pose(p, q, path, refine)
            assert_allclose(T @ kitti.invert(T), np.eye(4), atol=1e-9)  # fails for NaN, too


def test_odometry_warns_once_about_domain_shift_and_once_about_invalid_points(tmp_path):
    seen = [[1e5, 0.1, 1, 0.01], [2e5, 1, 100, 1]]
    odometry = d3dlo.Odometry(save_weights(tmp_path / "w.pt", random_net(generator(0)), seen=seen))
    scan = random_scan(generator(0), 60)
    invalid = np.insert(scan, [7, 8], np.nan, axis=0)
    with pytest.warns(UserWarning) as warned:
        for some_scan in (scan, invalid, scan, invalid):
            odometry.register(some_scan)
        odometry.restart()
        odometry.register(invalid)
    shift, dropped, *again = (str(warning.message) for warning in warned)
    assert shift.endswith("wrong: usable points 60 (in training 1e+05 to 2e+05)")  # nothing else
    assert "dropped 2 invalid points" in dropped and again == [dropped, shift]
    assert "mean intensity 50 (" in kitti.domain_shift([1, 50, 1, 1], [[1.0] * 4] * 2)
    assert kitti.domain_shift([1.4, 0.7, 1, 1], [[1.0] * 4] * 2) == ""


def test_the_pretrained_weights_are_accurate_on_an_unseen_sequence(tmp_path):
    kitti.simulate(tmp_path, seed=1, sequences=["06"], scans=6, workers=1)
    s, = kitti.open_sequences(tmp_path)
    assert np.linalg.norm(s.motions()[:, :3, 3], axis=1).mean() > 0.5
    for refine, metres, degrees in ((0, 0.12, 0.15), (2, 0.06, 0.08)):
        odometry = d3dlo.Odometry(refine=refine)
        poses = np.stack([odometry.register(s.scan(i)) for i in range(len(s))])
        t, r = metrics.step_errors(s.poses, poses).mean(0)
        assert count(odometry.net) == 61290 and t < metres and r < degrees


# ------------------------------------------------------------------------------------------------
# The commands


def test_eval_writes_what_it_prints_and_agrees_with_the_metric(cwd, capsys):
    shutil.copytree("root/sequences/03", "root/sequences/11")  # without ground truth
    out, results = succeeds(EVAL, capsys), read("out/results.json")
    sequences, splits, pooled = (results[key] for key in ("sequences", "splits", "pooled"))
    keys = ["segments", "E_t", "E_r", "t_step_m", "r_step_deg"]
    assert sorted(os.listdir("out")) == ["00.txt", "03.txt", "11.txt", "results.json"]
    assert list(sequences) == ["00", "03", "11"] and list(splits) == ["train", "test"]
    assert sequences["11"]["E_t"] is None
    for name, s in [*sequences.items(), *splits.items(), ("all", pooled)]:
        assert_allclose(figures(out, name), np.array([s[key] for key in keys], float), atol=6e-4)
        assert s["trained_on"] is False and f"{name} *" not in out

    # Compute the trajectories from the scans, and the errors from the trajectories
    segments, motion = [], from_vector(read("w.pt")["mean_motion"])
    for s, split in zip(kitti.open_sequences("root", ["00", "03"]), splits.values()):
        T = metrics.read_poses(f"out/{s.name}.txt")
        pairs = [relative_pose(s.scan(i), s.scan(i + 1), "w.pt") for i in range(14)]
        estimates = {"network": invert(s.Tr) @ T @ s.Tr, "standing still": [np.eye(4)] * 15,
                     "mean training motion": [np.linalg.matrix_power(motion, i) for i in range(15)]}
        assert_allclose(estimates["network"], d3dlo.accumulate(pairs), rtol=1e-3, atol=1e-3)
        for name, T in estimates.items():
            errors = devkit_errors(s.poses_cam, s.Tr @ T @ invert(s.Tr))
            expected = [*errors[:, 3:].mean(0), *metrics.step_errors(s.poses, T).mean(0)]
            got = (split | {"network": sequences[s.name]})[name]
            assert_allclose([got[key] for key in keys], [len(errors), *expected], rtol=1e-5)
            segments += [*errors[:, 3]] * (name == "network")
    assert list(results["lengths"]) == ["100 m"]  # for longer ones the drives are too short
    assert results["lengths"]["100 m"]["E_t"] == pooled["E_t"] == pytest.approx(np.mean(segments))
    succeeds(f"{EVAL}2 --refine 1", capsys)
    for name in ("00", "03"):  # every drive starts anew
        assert_allclose(metrics.read_poses(f"out2/{name}.txt")[0], np.eye(4), atol=1e-9)
    again = figures(succeeds("metrics root/poses out", capsys), "03")
    assert again[:3] == figures(out, "03")[:3]  # the errors per step are in the camera's frame


def test_eval_names_the_scans_that_are_unlike_the_training_data_or_have_invalid_points(cwd, capsys):
    weights(seen=[[60, 0.1, 1, 0.01], [1e6, 1, 100, 1]])()
    put(SCAN, lambda data: data[:16 * 30] + np.full(4, np.nan, "f4").tobytes())()
    assert run(EVAL) == 0
    err = capsys.readouterr().err
    assert "sequence 00: 1 of 15 scans look unlike" in err and "usable points 30 (" in err
    assert "sequence 00: dropped 1 invalid points" in err and "in 1 of 15 scans" in err


@pytest.mark.parametrize("refine", [0, 2])
def test_eval_of_a_plain_folder_writes_its_trajectory_and_refines_as_often_as_asked(
        cwd, capsys, refine):
    Path("drive/times.txt").write_text("\n".join(f"{1.3e9 + i}" for i in range(12)))
    Path("out").mkdir()  # an empty folder may be there
    out = succeeds(f"eval --data drive --weights w.pt --refine {refine} --out out", capsys)
    assert sorted(os.listdir("out")) == ["poses.tum", "poses.txt", "results.json"]
    poses, rows = metrics.read_poses("out/poses.txt"), np.loadtxt("out/poses.tum")
    odometry = d3dlo.Odometry("w.pt", refine=refine)
    expected = [odometry.register(np.load(f"drive/scan {i}.npy")) for i in range(1, 13)]
    assert_allclose(poses, expected, rtol=1e-3, atol=1e-3)
    assert_allclose(rows[:, :4], np.c_[1.3e9 + np.arange(12), poses[:, :3, 3]], atol=1e-6, rtol=0)
    assert_allclose(Rotation.from_quat(rows[:, 4:]).as_matrix(), poses[:, :3, :3], atol=1e-6)
    kitti.write_tum("a.tum", from_vector([[0, 0, 0, 0, 0, -150], [0, 0, 0, 9, 0, 150]]), [1, 2])
    assert (np.loadtxt("a.tum")[:, 7] >= 0).all()
    path = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum()
    assert read("out/results.json") == {"weights": "w.pt", "data": "drive", "refine": refine,
                                        "scans": 12, "path_m": pytest.approx(path)}
    assert f"drive: 12 scans, path of {path:.1f} m" in out


def test_without_data_train_simulates_the_city_and_stores_a_run_that_eval_reads(
        cwd, monkeypatch, capsys):
    simulate, held_out = kitti.simulate, [*SPLITS["test"], *SPLITS["validation"]]
    monkeypatch.setattr(kitti, "simulate", lambda root, sequences: simulate(
        root, sequences=sequences, scans=2, azimuth=100))
    succeeds("eval --weights w.pt --out out", capsys)
    assert sorted(os.listdir("data/simulated/sequences")) == sorted(held_out)
    out = succeeds("train --weights w.pt --epochs 2 --out new", capsys)
    made = read("new/config.json")
    assert Path("new/log.txt").read_text() == out and sorted(os.listdir("new")) == [
        "checkpoint.pt", "config.json", "log.txt", "results", "weights.pt"]
    assert re.findall(r"^epoch (.)/2: loss [\d.]+, test loss [\d.]+, ", out, re.M) == ["1", "2"]
    assert made["config"] == replace(SMALL, **SHORT | {"epochs": 2}).as_dict()
    assert made["versions"].keys() == {"commit", "d3dlo", "python", "numpy", "scipy", "torch"}
    assert made["arguments"]["sequences"] == list(SPLITS["train"])
    T = np.concatenate([s.motions() for s in kitti.open_sequences("data/simulated", "train")])
    assert_allclose(read("new/weights.pt")["mean_motion"], to_vector(T).mean(0), atol=1e-6)
    succeeds("eval --weights new --out again", capsys)
    at_the_end, again = read("new/results/results.json"), read("again/results.json")
    assert at_the_end["sequences"] == again["sequences"] and list(again["sequences"]) == held_out


def test_sequences_trained_on_have_a_star_also_after_fine_tuning_on_others(cwd, capsys):
    def starred(command):
        return re.findall(r"^(\w+) \*", succeeds(command, capsys), re.M)

    write_root("other", ["a", "b", "07"], seed=1)
    assert starred("eval --data root --weights run --out 1") == ["00", "train", "all"]
    assert starred("eval --data other --weights run --out 2") == []
    # Without sequences of the training split, those not held out are trained on
    assert starred("train --data other --weights run --epochs 1 --out later") == []
    assert starred("eval --data other --weights later --out 3") == ["a", "b", "all"]
    assert starred("eval --data root --weights later --out 4") == ["00", "train", "all"]
    put("other/sequences/a/velodyne/000005.bin", flip)()
    refused("train --out later --resume", "data has changed.*resume it with", capsys)


def test_every_option_of_train_has_an_effect(cwd):
    def train(options):
        assert run(f"train --data root --epochs 1 --out new {options}") == 0
        log, made = Path("new/log.txt").read_text(), read("new/weights.pt")
        shutil.rmtree("new")
        return log, made["config"], made["model"]

    first, _, model = train("--weights w.pt")
    for option, words in {"epochs 3": "epoch 3/3", "batch 7": "of 2 batches", "lr 0.25": "2.5e-01",
                          "sequences 03": "scans of 03", "short": "rate 4.0e-08"}.items():
        assert words in train(f"--weights w.pt --{option}")[0] and words not in first
    assert "test loss" in first and "test loss" not in train("--sequences 03 --weights w.pt")[0]
    for seed in (0, 1):
        other = train(f"--weights w.pt --seed {seed}")[2]
        assert torch.equal(model["mlp.0.weight"], other["mlp.0.weight"]) == (seed == 0)
    shutil.rmtree("root/sequences/03")
    for i in range(15):  # enough points for the network of Table 1
        random_scan(generator(i), 1200).tofile(f"{SCANS}/{i:06d}.bin")
    (_, config, model), (*_, other), (*_, again) = (
        train(f"--neighbors 5 --no-plane --lr 1e-9 --seed {seed}") for seed in (0, 1, 0))
    sa1 = Layer(1.0, 1024, 5, (4, 8, 16, 32))
    assert config == Config(epochs=1, lr=1e-9, plane=False, sa1=sa1).as_dict()
    assert (model["mlp.0.weight"] - other["mlp.0.weight"]).abs().max() > 1e-3  # initial weights
    assert torch.equal(model["mlp.0.weight"], again["mlp.0.weight"])


def test_train_uses_the_config_and_the_objective_that_it_is_given(cwd):
    config = replace(PAPERS, epochs=np.int64(4), lr=np.float32(2**-10))  # exact in float32
    d3dlo.train(config, "root", "00", "new", device=torch.device("cpu"), objective=Loss())
    assert (read("new/checkpoint.pt")["parts"][1]["weights"] != 0).all()  # learned, by Adam
    assert read("new/weights.pt")["config"] == replace(PAPERS, epochs=4, lr=2**-10).as_dict()
    with pytest.raises(ValueError, match="within 1000 m.* needs 1024"):
        d3dlo.train(data="root")  # the paper's settings


def test_a_run_without_a_checkpoint_yet_is_resumed_from_the_weights_it_started_with(cwd):
    assert run(f"{TRAIN} --lr 1e-9") == 0
    shutil.copytree("new", "part")
    delete("part/checkpoint.pt", "part/weights.pt")()
    assert run("train --out part --resume") == 0
    assert files_in(Path("part")) == files_in(Path("new"))


LONG = "train --data root --weights w.pt --short --epochs 4 --batch 4 --seed 3 --out"


def train_until(action):
    """Train, and let something happen in the middle of writing the fourth checkpoint."""
    checkpoints = itertools.count(1)

    def write_bytes(path, data, write=Path.write_bytes):
        if "checkpoint.pt" in path.name and next(checkpoints) == 4:
            write(path, data[:len(data) // 2])
            action()
        write(path, data)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Path, "write_bytes", write_bytes)
        patch.setattr(d3dlo, "CHECKPOINT_EVERY", 0)
        patch.setattr(sys, "stdout", sys.stdout)  # to restore it
        return run(f"{LONG} new")


ENDS = {"killed": (lambda: os._exit(9), 9, None),
        "SIGTERM": (lambda: signal.raise_signal(signal.SIGTERM), 130, "continue with .* --resume"),
        "closed stdout": (lambda: setattr(sys, "stdout", Mock(write=Mock(
            side_effect=BrokenPipeError))), 2, "standard output was closed; .* --resume")}


@pytest.mark.parametrize("end", ENDS)
def test_an_interrupted_training_run_is_resumed_to_the_same_bits(cwd, capsys, end):
    action, code, line = ENDS[end]
    assert run(f"{LONG} whole") == run(EVAL) == 0
    capsys.readouterr()
    if line:
        assert train_until(action) == code
        assert re.search(line, *error_lines(capsys.readouterr().err))
    else:  # in a process of its own
        script = f"import {__name__} as t; t.train_until(t.ENDS[{end!r}][0])"
        environment = os.environ | {"PYTHONPATH": str(HERE)}
        ran = subprocess.run([sys.executable, "-c", script], env=environment, timeout=60)
        assert ran.returncode == code
    assert 0 < read("new/checkpoint.pt")["step"] < read("whole/checkpoint.pt")["step"]
    shutil.copytree("out", "new/results")  # replaced at the end
    assert run("train --out new --resume") == 0
    assert sorted(os.listdir("new/results")) == ["03.txt", "results.json"]
    new, whole = read("new/weights.pt")["model"], read("whole/weights.pt")["model"]
    assert all(torch.equal(new[name], whole[name]) for name in whole)


def full(*arguments, **options):
    raise OSError(28, "No space left on device")


@pytest.mark.parametrize("command, module, name, file", [
    (EVAL, np, "savetxt", "out/00.txt"), (TRAIN, Path, "write_bytes", "new/weights.pt"),
    (EVAL, Path, "write_text", "out/results.json"),
    (EVAL, np.lib.format, "write_array_header_1_0", "cache/00-")])
def test_a_full_disk_fails_with_one_line_that_names_the_file(
        cwd, monkeypatch, capsys, command, module, name, file):
    monkeypatch.setattr(module, name, full)
    assert run(command) == 2
    line, = error_lines(capsys.readouterr().err)
    assert "No space left on device" in line and file in line


def test_a_raw_drive_is_converted_whole_or_not_at_all(cwd, monkeypatch, capsys):
    def savetxt(file, *arguments, savetxt=np.savetxt, **options):
        (full if "drive_0013-2.txt" in file.name else savetxt)(file, *arguments, **options)

    delete(*map(RAW_SCAN.format, (3, 4)))()  # two parts
    for folder in ("poses", "sequences"):
        Path("new", folder).mkdir(parents=True)
    monkeypatch.setattr(np, "savetxt", savetxt)
    refused(f"raw {DRIVE} new", "-2.txt.*No space left", capsys)


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
    monkeypatch.setattr("time.strftime", lambda form: form.replace("%S", "0"))  # the same second
    command, codes = command.partition(" --out")[0] if default else command, []
    during(monkeypatch, d3dlo, "claim_output", lambda: codes.append(run(command)))
    codes.append(run(command))
    lines = error_lines(capsys.readouterr().err)
    if default:
        one, two = (os.listdir(path) for path in Path(".").glob("r*s/*"))  # runs/ or results/
        assert codes == [0, 0] and lines == [] and sorted(one) == sorted(two)
    else:
        assert codes == [0, 2] and len(lines) == 1 and re.search("--out.*choose", lines[0])


# ------------------------------------------------------------------------------------------------
# Bad input, and the documentation


def weights(**changes):
    """A function that changes the content of w.pt. None removes a key."""
    return lambda: torch.save({key: value for key, value in (read("w.pt") | changes).items()
                               if value is not None}, "w.pt")


def cut(text):
    """Drop the last word."""
    return text.rstrip().rpartition(b" ")[0]


SCAN, NPY, TIMES = f"{SCANS}/000003.bin", "drive/scan 1.npy", "drive/times.txt"
CITY = "simulate city --sequences 07 --scans 2 --azimuth 100"
PLOT = "metrics root/poses root/poses --plot"
CASES = [  # commands, and {what the message must say: what spoils good data}
    ((EVAL, TRAIN), {
        "root has no scans.*unpack": delete("root/sequences/03", SCANS),
        "unpack.*ROOT/sequences/00/": delete("root/sequences"), "003.bin has 0": put(SCAN, b""),
        "003.bin.*unpack": delete(SCAN), "003.bin.*bytes.*unpack": put(SCAN, lambda b: b[:-3]),
        "003.bin is not a KITTI scan.*save": put(SCAN, b"\x93NUMPY0123456789"),
        "003.bin: 10 different usable.*metres": put(SCAN, lambda b: b[:16 * 10]),
        "00.txt has 14 poses.*unpack": put(POSES, lambda b: b.partition(b"\n")[2]),
        "00.txt, line 15: 11 words.*correct": put(POSES, cut), "00.txt.*give": put(POSES, b"\n"),
        "00.txt, line 15: 12": put(POSES, lambda b: cut(b) + b" inf"),
        "00.txt: pose 1 .*must be": put(POSES, lambda b: b.replace(b"\n", b"\n9", 1)),
        "00.txt: pose 0 .*must be": put(POSES, lambda b: b"-" + b),  # a mirror
        "00.txt.*UTF-16.*save": put(POSES, lambda b: b.decode().encode("utf-16")),
        "calib.txt.*write": delete(CALIB), "calib.txt has no row 'Tr'.*write": put(CALIB, cut)}),
    (["eval --data drive --weights w.pt"], {
        "both .bin and .npy files: move": put("drive/0.bin", bytes(16)),
        "1.npy does not hold.* 0 to 255.*save": put(NPY, np.full((9, 4), 300)),
        "1.npy does not hold.*float32": put(NPY, np.full((9, 4), -0.5)),
        "is damaged.*save": put(NPY, b"damaged"),
        r"1.npy.*\(9, 5\).*save": put(NPY, np.ones((9, 5))),
        "1.npy.*save": put(NPY, np.array(Mischief())), "must hold 12": put(TIMES, b"1 2 3"),
        "increasing.*correct": put(TIMES, b"1\n" * 12),
        "times.txt.*in seconds": put(TIMES, b"2011-09-26 10:00\n" * 12)}),
    ([f"raw {DRIVE} new"], {
        "points/timestamps.txt.*_0013_sync.zip": delete(SCAN_TIMES),
        "oxts/data/0000000000.txt.*_sync.zip": delete(f"{DRIVE}/oxts/data"),
        "calib_cam_to_cam.txt.*_calib.zip": delete(f"{DATE}/calib_cam_to_cam.txt"),
        "oxts/timestamps.txt is damaged.*unpack": put(PACKET_TIMES, b"2011-09-26 13:10:51.1\n"),
        "points/timestamps.txt is damaged.*unpack": put(SCAN_TIMES, b"noon\n" * 12),
        "within 0.1 s.*unpack": put(PACKET_TIMES, b"2011-09-28 13:10:51.1\n" * 12),
        "5.txt is damaged.*30.*unpack": put(PACKET.format(5), cut),
        "5.txt is damaged.*latitude.*unpack": put(PACKET.format(5), lambda b: b"2" + b),
        "7.bin has 639 bytes": put(RAW_SCAN.format(7), lambda b: b[:-1]),
        "imu_to_velo.txt is damaged.*unpack": put(f"{DATE}/calib_imu_to_velo.txt", cut)}),
    (["train --resume --out run"], {
        "checkpoint.pt: .*zip.*delete it": put("run/checkpoint.pt", b"damaged")}),
    ((EVAL, TRAIN), {f"w.pt: .*{words}.*give": spoil for words, spoil in {
        "size mismatch": weights(config=Config().as_dict()), "config": weights(config=None),
        "epochs is 0": weights(config=SMALL.as_dict() | {"epochs": 0}),
        "'swap'": weights(config=SMALL.as_dict() | {"swap": "both"}),  # a setting that is gone
        "model": weights(model=None), "seen": weights(seen=None), "checkpoint": weights(parts=[]),
        "damaged": weights(mean_motion=[math.nan] * 6), "safety": weights(model=Mischief()),
        "zip": put("w.pt", pickle.dumps(Mischief())), "cannot": put("w.pt", lambda b: b[:-2000]),
        "read": lambda: torch.save([1.0], "w.pt"),
        "weights": put("w.pt", lambda b: b[:20000] + bytes(200) + b[20200:])}.items()})]
BAD_ARGUMENTS = {
    "eval --data ''": "--data is empty; give", "eval --data gone": "gone: .*check",
    "eval --data w.pt": "w.pt is a file: give", "eval --data clouds": "clouds.*save .* as .npy",
    "eval --data root/sequences": "root/sequences .*give the folder that holds",
    "eval --data clouds/0.pcd": "0.pcd .*docs/your-data.md",
    "eval --data five": r"five/0.bin.*nuScenes.*reshape\(-1, 5\)", "metrics root x": "x: .*give",
    "eval --data root --sequences ../sequences/00": "../sequences/00.*choose",
    "eval --weights gone.pt": "gone.pt: no such.*give", "eval --weights root": "root/weights.*give",
    "eval --weights run/checkpoint.pt": "run/checkpoint.pt.*only --resume.*give",
    "eval --sequences 0O": "0O; available", "eval --device nonsense": "nonsense.*use cpu",
    "eval --refine -1": "refine is -1", "eval --refine 101": "refine is 101",
    "train --resume": "config.json.*give.*--out", "train --sequences 0O": "0O; available",
    "train --resume --out run --seed 0": "--resume.*give only --out",
    "train --data drive": "drive has no ground truth", "train --seed -1": "seed is",
    "train --weights w.pt --no-plane": "--weights.*--no-plane", "train --lr nan": "lr is nan",
    "train --weights w.pt --neighbors 8": "--weights.*do not combine it with --neighbors",
    "train --epochs 0": "epochs is 0.*must be", "train --batch 0": "batch is 0.*must be",
    f"train --seed {10**23}": "seed is", "raw root new": "root is not a drive.*give",
    f"{CITY} --azimuth 200": "07.*choose another", f"{CITY} --seed 1": "07.*choose another",
    f"{CITY} --scans 0": "scans.*must be", f"{CITY} --sequences ../x": "../x.*use",
    f"{CITY} --sequences .x": "'.x'.*use",
    "simulate root --sequences 00": "00.*choose", "metrics root/poses clouds": "clouds.*give two",
    f"metrics {POSES} gone.txt": "gone.txt", f"metrics root/poses {POSES}": "00.txt.*give two",
    f"{PLOT} {POSES}": "--plot root/poses/00.txt.*give", f"{PLOT} a.jpg": "--plot a.jpg.*give"}


@pytest.mark.parametrize("command, spoil, words", [
    *((command, spoil, words) for commands, cases in CASES for command in commands
      for words, spoil in cases.items()),
    *((command, lambda: None, words) for command, words in BAD_ARGUMENTS.items())])
def test_bad_input_fails_with_one_line_that_names_it_and_writes_nothing(
        cwd, capsys, command, spoil, words):
    spoil()
    refused(command, words, capsys)
    assert not Path("mischief").exists()


def test_python_in_the_documentation_runs_and_its_commands_parse(cwd, monkeypatch):
    def parse_only(parser, arguments=None, parse=argparse.ArgumentParser.parse_args):
        parse(parser, arguments)  # raises SystemExit(2) if they are invalid
        raise SystemExit("parsed")

    pages, benchmarks = [HERE / "README.md", *sorted(HERE.glob("docs/*.md"))], HERE / "benchmarks"
    text = "\n".join(page.read_text(encoding="utf-8") for page in pages if page.exists())
    for block in re.findall(r"```python\n(.*?)```", text, re.S):
        exec(compile(block, "a page", "exec"), {})
    commands = re.findall(r"^(?:pip install \S+ && )?python (\S+\.py)([^#\n]*)", text, re.M)
    commands += re.findall(r"`python (\S+\.py)([^`]*)`", text)
    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parse_only)
    monkeypatch.syspath_prepend(benchmarks)  # its scripts import each other
    for script, arguments in commands:
        if benchmarks.exists() or not script.startswith("benchmarks"):  # not in a distribution
            monkeypatch.setattr(sys, "argv", [script, *arguments.split()])
            with pytest.raises(SystemExit, match="parsed"):
                runpy.run_path(str(HERE / script), run_name="__main__")
    assert len(commands) > 20 or not benchmarks.exists()


@pytest.mark.skipif(not (HERE / "docs").exists(), reason="not in a distribution")
def test_the_cells_of_the_tour_run_and_print_what_it_shows(cwd, capsys):
    cells = json.loads((HERE / "docs/tour.ipynb").read_text(encoding="utf-8"))["cells"]
    names, numbers = {}, r"-?\d[\d,]*\.?\d*"
    for cell in (cell for cell in cells if cell["cell_type"] == "code"):
        source = "".join(cell["source"])
        if source.startswith("# Draw") and not importlib.util.find_spec("matplotlib"):
            continue
        exec(compile(source, "a cell", "exec"), names)
        shown = "".join(line for output in cell["outputs"] for line in output.get("text", ()))
        printed = capsys.readouterr().out
        assert re.sub(numbers, "#", printed) == re.sub(numbers, "#", shown)
        for now, then in zip(re.findall(numbers, printed), re.findall(numbers, shown)):
            assert_allclose(*(float(text.replace(",", "")) for text in (now, then)), atol=0.02)


# ------------------------------------------------------------------------------------------------
# Every kind of input that people bring


@pytest.mark.parametrize("dtype, columns, kind", [
    ("float32", 5, "five floats"), ("float64", 4, "float64"), ("float32", 6, "six floats")])
@given(seed=SEED)
@settings(max_examples=5)
def test_other_columns_are_named_with_a_remedy_that_works(tmp_path, dtype, columns, kind, seed):
    scan, rings = random_scan(generator(seed), 400), np.arange(400)[:, None] % [[64, 7]]
    np.c_[scan, rings][:, :columns].astype(dtype).tofile(tmp_path / "0.bin")
    with pytest.raises(ValueError, match=f"0.bin .*looks like {kind}.*np.save") as refusal:
        kitti.read_scan(tmp_path / "0.bin")
    remedy = re.search(r"np.save\(.*\)", str(refusal.value))[0]
    exec(remedy, {"np": np, "OLD": tmp_path / "0.bin", "NEW": tmp_path / "0.npy"})
    assert_array_equal(kitti.read_scan(tmp_path / "0.npy"), scan)


def test_intensities_of_0_to_255_are_scaled_and_said_and_outliers_are_clipped(cwd, capsys):
    good = random_scan(generator(0), 400)
    good[:3, 3] = 1, 0, 1
    outliers = good.copy()
    outliers[:3, 3] = 30, -0.001, 1.5  # less than 1 % of the points
    for i in range(15):
        outliers.tofile(f"{SCANS}/{i:06d}.bin")
    s, = kitti.open_sequences("root", "00")
    assert s.notes == []
    assert_array_equal(s.scan(0), good)

    for i in range(15):
        (good * np.float32([1, 1, 1, 255])).tofile(f"{SCANS}/{i:06d}.bin")
    s, = kitti.open_sequences("root", "00")
    assert_allclose(s.scan(0), good, rtol=1e-6)
    for command in ("eval --data root --sequences 00 --weights w.pt",
                    "train --data root --sequences 00 --weights w.pt --epochs 1"):
        assert run(command) == 0
        assert "sequence 00: intensities reach 255; all are divided" in capsys.readouterr().err
    records, = load_records([s], SMALL)
    assert_allclose(records["stats"][:, 1], good[:, 3].mean(), rtol=1e-4)
    np.save("16bit.npy", good * np.float32([1, 1, 1, 4095]))
    assert_allclose(kitti.read_scan("16bit.npy", 4095), good, rtol=1e-6)
    for maximum in (0, -1, np.nan, np.inf):
        with pytest.raises(ValueError, match="intensity_max is"):
            kitti.read_scan("16bit.npy", maximum)


def test_points_without_a_return_are_dropped_and_copies_do_not_count(tmp_path):
    scan = random_scan(generator(0), 60)
    records = scan_records(np.insert(scan, [5] * 9, 0, axis=0), SMALL)
    assert records["invalid"] == 0 and records.tobytes() == scan_records(scan, SMALL).tobytes()
    with pytest.raises(ValueError, match="15 different usable points"):
        scan_records(np.repeat(scan[:15], 9, axis=0), SMALL)


def test_numbers_as_names_are_sorted_by_value_and_gaps_in_time_are_noted(tmp_path):
    names = ["8.9", "8.95", "9.0", "9.05", "9.1", "10.15"]
    for i, name in enumerate(names):
        random_scan(generator(i), 50).tofile(tmp_path / f"{name}.bin")
    assert [path.stem for path in kitti.scans_in(tmp_path)] == names
    s, = kitti.open_sequences(tmp_path)
    assert any("20 scans are missing by the file names, the first after 9.1.bin" in note
               for note in s.notes)
    times = tmp_path / "times.txt"
    times.write_text("\ufeff0\n0.1\n0.2\n0.35\n0.46\n0.56\n", "utf-8")  # not quite regular
    assert len(kitti.Sequence(tmp_path).notes) == 1
    times.write_text("0\n0.1\n0.2\n0.5\n0.6\n0.7\n")
    notes = kitti.Sequence(tmp_path).notes
    assert any("2 scans are missing by the times.txt, the first after 9.0.bin" in note
               for note in notes)
    times.write_text("\n".join(f"{i}00000000" for i in range(6)))
    with pytest.raises(ValueError, match="cannot be seconds: divide nanoseconds"):
        kitti.Sequence(tmp_path)


def test_a_wild_step_of_the_truth_is_named(cwd, capsys):
    T = metrics.read_poses(POSES)
    T[2:] = T[2:] @ from_vector([0, 0, 0, 0, 60, 0])
    metrics.write_poses(POSES, T)
    for command in (EVAL, TRAIN):
        assert run(command) == 0
        assert re.search(r"00.txt, from line 2 to 3: a step of \d+.\d m and (5[89]|6[01]) deg",
                         capsys.readouterr().err)


def test_trajectories_are_drawn_from_a_common_start_and_frames_are_compared(cwd, capsys):
    pytest.importorskip("matplotlib")
    lidar = d3dlo.accumulate([from_vector([1.0, 0, 0, 0, 0, 5])] * 9)
    elsewhere = from_vector([3e5, 4e6, 30, 0, 0, 90]) @ lidar
    for name, T in dict(lidar=lidar, elsewhere=elsewhere, camera=straight_path(10, 1)).items():
        metrics.write_poses(f"{name}.txt", T)
    out = succeeds("metrics lidar.txt elsewhere.txt --plot 'a $_1.svg'", capsys)
    assert figures(out, "lidar")[5] < 0.01 and "a $_1.svg" in out  # ATE
    assert run("metrics camera.txt lidar.txt") == 0
    assert "different frames" in capsys.readouterr().err
    os.rename("drive", "run_$1_$2 \udcff")  # a byte that is no UTF-8
    assert run("eval --data 'run_$1_$2 \udcff' --weights w.pt --plot --out o") == 0
    assert {"plot.png", "results.json"} < set(os.listdir("o"))


def test_a_tilde_in_a_path_is_the_home_folder(cwd, monkeypatch):
    monkeypatch.setenv("HOME", str(cwd / "home"))
    shutil.copytree("drive", "home/drive")
    assert run("eval --data=~/drive --weights w.pt --out=~/out") == 0
    assert run("metrics ~/out/poses.txt ~/out/poses.txt") == 0
    assert "scans" in read("home/out/results.json")


def test_odometry_does_not_depend_on_torchs_defaults_and_survives_strict_warnings(tmp_path):
    path, scans = save_weights(tmp_path / "w.pt", random_net(generator(0))), [
        random_scan(generator(i), 60) for i in range(3)]
    expected = [*map(d3dlo.Odometry(path).register, scans)]
    torch.set_default_dtype(torch.float64)
    try:
        assert_array_equal([*map(d3dlo.Odometry(path).register, scans)], expected)
    finally:
        torch.set_default_dtype(torch.float32)
    odometry = d3dlo.Odometry(path)
    odometry.register(scans[0])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(UserWarning, match="invalid points"):
            odometry.register(np.r_[scans[2], [[np.nan] * 4]])
    assert_array_equal([*map(odometry.register, scans[1:])], expected[1:])
    for scan in ({}, np.zeros(60, "f4, f4"), scans[0].astype(complex), None, [["x"] * 4]):
        with pytest.raises(ValueError, match="array of numbers"):
            odometry.register(scan)


def test_progress_needs_no_stderr(monkeypatch):
    monkeypatch.setattr(sys, "stderr", None)
    assert [*kitti.progress(range(3), 3, "work")] == [0, 1, 2]


def print_process(_):
    os.write(1, b"%d\n" % os.getpid())  # in one piece: two processes share the pipe
    threading.Event().wait(60)


@pytest.mark.skipif(sys.platform == "win32", reason="not tried on Windows")
@pytest.mark.parametrize("method", multiprocessing.get_all_start_methods())
def test_workers_work_and_end_when_their_parent_is_killed(method):
    script = (f"import {__name__} as t; t.multiprocessing.set_start_method('{method}'); "
              "[*t.kitti.in_processes(t.print_process, [0, 1], 2, 1)]")
    parent = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True,
                              env=os.environ | {"PYTHONPATH": str(HERE)})
    for _ in range(2):  # wait until both are at work
        assert int(parent.stdout.readline()) != parent.pid
    parent.kill()
    parent.communicate(timeout=60)  # returns when no process holds the other end of the pipe


# ------------------------------------------------------------------------------------------------
# What the paper tried and rejected


@pytest.fixture(scope="module")
def experiments():
    path = HERE / "benchmarks" / "experiments.py"
    if not path.exists():
        pytest.skip("the source distribution does not hold benchmarks/")
    return SimpleNamespace(**runpy.run_path(str(path)))


@pytest.mark.parametrize("name, parameters", [
    ("Quaternion", 61290 + 65), ("Coordinates", 61290 + 3 * 64),
    # A second SA1, and 2 x 32 more input features of FE's first layer, which is 32 wide
    ("TwoScales", 61290 + 868 + 2 * 32 * 32)])
def test_rejected_networks_are_trained_stored_and_loaded(tmp_path, experiments, name, parameters):
    network, objective = getattr(experiments, name), experiments.UncertaintyLoss()
    if name == "Quaternion":
        objective = experiments.QuaternionLoss(objective)
    assert count(network()) == parameters
    train(tmp_path, OURS, network=network, objective=objective)
    assert all(w.abs().min() > 0 for w in objective.parameters())  # they are 0 at the start
    T, = d3dlo.predict_motions(load_weights(tmp_path, network)[0], two_sequences()[0][0][:2])
    assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-6)
    with pytest.raises(ValueError, match="weights.pt"):
        load_weights(tmp_path)  # of another network


@given(SEED, st.sampled_from([0, 1]), st.sampled_from([-1, 0, 1e-4, 1]), st.sampled_from([0, 1]))
def test_losses_follow_their_definitions_and_have_finite_gradients(
        experiments, seed, speed, prediction, noise):
    """The target stands still or moves; the prediction may be equal to it or opposite."""
    def l1(y_hat, y):  # eq. 2
        return np.abs(y_hat - y).mean()

    def eq_5(y_hat, y):  # a length below 0.001 counts as 0.001
        lengths = [np.maximum(np.linalg.norm(part, axis=1), 1e-3) for part in (y_hat, y)]
        return np.mean(1 - np.sum(y_hat * y, 1) / lengths[0] / lengths[1])

    def uncertainty(y_hat, y, s_t, s_r):
        return (l1(y_hat[:, :3], y[:, :3]) * np.exp(-s_t) + s_t
                + l1(y_hat[:, 3:], y[:, 3:]) * np.exp(-s_r) + s_r)

    rng, e = generator(seed), experiments
    T = random_motion(rng, speed, n=5)
    v, quaternions = to_vector(T), e.Quaternion.encode(T)
    assert_allclose(quaternions[:, 3:], Rotation.from_matrix(T[:, :3, :3]).as_quat(), atol=1e-12)
    assert_allclose(e.Quaternion.decode(quaternions * [1, 1, 1, -1, -1, -1, -1]), T, atol=1e-9)
    for objective, y, definition in (
            (e.CosineLoss(0.1), v, lambda y_hat, y: l1(y_hat, y) + 0.1 * eq_5(y_hat, y)),
            (e.CosineLoss(1.0, n=3), v, lambda a, b: l1(a, b) + eq_5(a[:, :3], b[:, :3])),
            (e.UncertaintyLoss(), v, uncertainty),
            (e.QuaternionLoss(e.UncertaintyLoss()), quaternions, uncertainty)):
        y_hat = torch.from_numpy(prediction * y + noise * rng.normal(size=y.shape)).requires_grad_()
        learned = [float(x) for w in objective.double().parameters() for x in w.data.normal_()]
        loss = objective(y_hat, torch.from_numpy(y))
        gradients = torch.autograd.grad(loss, [y_hat, *objective.parameters()])
        assert all(gradient.isfinite().all() for gradient in gradients)
        y_hat = y_hat.detach().numpy()
        if y is quaternions:  # q and -q are the same rotation; the nearer one is the target
            y[(y_hat[:, 3:] * y[:, 3:]).sum(1) < 0, 3:] *= -1
        assert_allclose(loss.item(), definition(y_hat, y, *learned), rtol=1e-9, atol=1e-9)


@given(SEED, st.sampled_from([100, 600, 3000]))
@settings(max_examples=10)
def test_rejected_networks_see_two_balls_and_coordinates(experiments, seed, N):
    rng, config = generator(seed), replace(SMALL, sa1=Layer(2.0, 16, 12, (4, 8, 16)))
    scan, features = random_scan(rng, N), []
    record, = scan_records(scan, config)
    mpn = random_net(rng, config, experiments.TwoScales).sa1.mpn
    for part, r, n_n in ((mpn.small, 1.0, 3), (mpn.large, 2.0, 12)):
        centroids = fps_by_definition(scan[:, :3], 16)
        ball = scan[nearest(scan[:, :3], record["xyz"], n_n, r, centroids)][..., [3, 0, 1, 2]]
        ball[..., 1:] -= record["xyz"][:, None]
        features.append(part(torch.from_numpy(ball)))
    got = mpn(torch.from_numpy(record["group_sa1"])[None])[0]
    torch.testing.assert_close(got, torch.cat(features, -1), rtol=1e-5, atol=1e-5)
    net, (batch, _) = random_net(rng, SMALL, experiments.Coordinates), random_batch(rng)
    shifted = batch._replace(xyz=batch.xyz + torch.tensor([20.0, -10.0, 0.0]))
    assert (net(shifted) - net(batch)).abs().max() > 1e-2  # D3DLO sees coordinate differences only
