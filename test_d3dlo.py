"""Tests of D3DLO. Expected values never come from the code under test.

They come from an independent source: brute force, SciPy, a definition written out, or a closed
form. Real data are optional: D3DLO_KITTI names a folder in KITTI odometry layout; without it the
tests that need one are skipped.
"""
import argparse
import contextlib
import copy
import errno
import io
import json
import math
import os
import pickle
import re
import runpy
import shutil
import signal
import subprocess
import sys
import time
import warnings
import zipfile
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation
from torch.optim.swa_utils import update_bn

import d3dlo
import kitti
import metrics
from d3dlo import (
    D3DLO,
    Config,
    Layer,
    farthest_point_sampling,
    fps_textbook,
    group_ball,
    group_knn,
    load_geometry,
    load_weights,
    scan_geometry,
)
from kitti import from_vector, invert, to_vector

settings.register_profile(
    "d3dlo", deadline=None, derandomize=True, database=None, max_examples=25,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
settings.load_profile("d3dlo")

HERE = Path(__file__).resolve().parent
KITTI = Path(os.environ.get("D3DLO_KITTI", "no folder")).resolve()  # real data, optional
SEED = st.integers(0, 2**32 - 1)
generator = np.random.default_rng

# A network with every kind of layer and a hundredth of the work
SMALL = Config(sa1=Layer(2.0, 32, 4, (4, 8, 16)),
               fe=Layer(None, None, 6, (16, 32)),
               sa2=Layer(4.0, 16, 8, (32, 32)),
               sa3=Layer(8.0, 8, 4, (32, 32)),
               mpn=Layer(None, None, None, (32, 64)),
               mlp=Layer(None, None, None, (32, 6)),
               max_range=50.0, swap="both")

# What a weights file keeps about its training data. The ranges in `seen` fit any scan.
FACTS = dict(train={}, before=[], mean_motion=[1.0, 0, 0, 0, 0, 0],
             seen=[[1.0, 0.1, 1.0, 0.01], [1e6, 1.0, 100.0, 1.0]])


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
    steps = np.abs(rng.normal(size=(n - 1, 6))) * scale
    signs = [1, *rng.choice([-1, 1], 5)]
    return d3dlo.accumulate(from_vector(steps * signs))


def transform(T, xyz):
    """Apply a rigid motion T (4,4) to points (...,3)."""
    return xyz @ T[:3, :3].T + T[:3, 3]


def transform_scan(T, scan):
    return np.c_[transform(T, scan[:, :3].astype(float)), scan[:, 3]].astype(np.float32)


def pairs_of_scans(rng, n, points=64, config=SMALL):
    """n sequences of two scans, P and P moved -> geometry and motions as `fit` takes them."""
    clouds, motions = [random_scan(rng, points) for _ in range(n)], random_motion(rng, n=n)
    geometry = []
    for p, T in zip(clouds, motions):
        q = transform_scan(invert(T), p)
        geometry.append(np.stack([scan_geometry(scan, config) for scan in (p, q)]))
    return geometry, list(motions[:, None])


def random_sequences():
    """Two sequences of six unrelated scans, for tests where it does not matter what is learned."""
    rng = generator(0)
    geometry = []
    for _ in range(2):
        geometry.append(np.stack([scan_geometry(random_scan(rng, 48), SMALL) for _ in range(6)]))
    return geometry, [random_motion(rng, n=5) for _ in range(2)]


def random_batch(rng, config=SMALL, pairs=3):
    """A Batch and the poses of its pairs, as in training."""
    geometry, motions = pairs_of_scans(rng, pairs, config.sa1.n_fps + 76, config)
    return d3dlo.training_batch(geometry, motions, [(i, 0) for i in range(pairs)], config, rng)


def in_double(batch):
    """A Batch with coordinates and features in double precision."""
    return batch._replace(xyz=batch.xyz.double(), group_sa1=batch.group_sa1.double())


def batch_norms(net):
    """The BatchNorm layers of a network."""
    return [module for module in net.modules() if hasattr(module, "running_mean")]


def random_net(rng, config=SMALL, network=D3DLO):
    """An untrained network in eval mode whose predictions depend on the input.

    Its BatchNorm scales have both signs and its running statistics fit the data.
    """
    torch.manual_seed(int(rng.integers(2**31)))
    net = network(config)
    for norm in batch_norms(net):
        norm.weight.data = torch.randn_like(norm.weight)
        norm.bias.data = torch.randn_like(norm.bias)
    update_bn([random_batch(rng, config)], net)
    return net.eval()


def predict(net, p, q):
    """Scans p, q (N,4) -> the predicted motion as a vector (6,)."""
    records = np.stack([scan_geometry(scan, net.config) for scan in (p, q)])
    return to_vector(d3dlo.predict_motions(net, records))[0]


# ------------------------------------------------------------------------------------------------
# Sampling and grouping

KINDS = st.sampled_from(["grid", "duplicates", "line", "float32", "float64"])


def random_points(rng, kind, N):
    """Points (N,3) of one of the KINDS, many of them with ties between distances."""
    if kind == "grid":  # full of ties, and exact in floating point
        return rng.integers(-4, 5, (N, 3)).astype(np.float32)
    if kind == "duplicates":
        different = max(N // 3, 1)
        xyz = rng.normal(size=(different, 3)).astype(np.float32)
        return xyz[rng.integers(different, size=N)]
    if kind == "line":
        return np.outer(rng.normal(size=N), [1, 0, 0]).astype(np.float32)
    return (rng.normal(size=(N, 3)) * [20, 20, 2]).astype(kind)


def fps_by_definition(xyz, n, start=0):
    """Each centroid is the point farthest from the nearest earlier one, by a distance matrix."""
    x, y, z = ((column[:, None] - column) ** 2 for column in xyz.T)  # (N,N)
    D = x + y + z
    centroids = [start]
    for _ in range(n - 1):
        min_dist = D[centroids].min(0)
        centroids.append(int(min_dist.argmax()))  # ties go to the lowest index
    return np.array(centroids)


@given(SEED, KINDS, st.integers(1, 60))
def test_fps_textbook_follows_the_definition(seed, kind, N):
    xyz, start = random_points(generator(seed), kind, N), seed % N
    assert_array_equal(fps_textbook(xyz, N, start), fps_by_definition(xyz, N, start))


N_POINTS = st.sampled_from([1, 2, 3, 191, 192, 193, 385]) | st.integers(1, 1500)


@given(SEED, KINDS, N_POINTS, st.sampled_from([20, 60, 1500]))
@settings(max_examples=150)
def test_farthest_point_sampling_returns_the_same_indices_as_fps_textbook(seed, kind, N, n):
    xyz, n, start = random_points(generator(seed), kind, N), min(n, N), seed % N
    assert_array_equal(farthest_point_sampling(xyz, n, start), fps_textbook(xyz, n, start))


@given(SEED, st.integers(1, 5), st.integers(20, 700))
def test_farthest_point_samplings_are_those_of_each_cloud(seed, K, N):
    rng = generator(seed)
    clouds = np.stack([random_scan(rng, N)[:, :3] for _ in range(K)])
    clouds[0] = np.round(clouds[0] / 10)  # with many ties
    expected = [fps_textbook(xyz, 20) for xyz in clouds]
    assert_array_equal(d3dlo.batched_fps(clouds, 20), expected)


@pytest.mark.parametrize("N, n", [(5, 6), (5, 0), (0, 1), (1023, 1024)])
def test_farthest_point_sampling_refuses_0_samples_or_more_than_there_are_points(N, n):
    with pytest.raises(ValueError, match=f"{n} .*{N}"):
        farthest_point_sampling(np.zeros((N, 3), np.float32), n)


@given(SEED, KINDS, st.integers(1, 300), st.integers(1, 12), st.sampled_from([0.5, 1.0, 2.0, 5.0]))
@settings(max_examples=50)
def test_group_ball_equals_brute_force(seed, kind, N, n_n, r):
    rng = generator(seed)
    xyz, centroids = random_points(rng, kind, N), rng.integers(N, size=20)
    D = cdist(xyz[centroids].astype(float), xyz.astype(float))
    for c, dist, row in zip(centroids, D, group_ball(xyz, centroids, r, n_n), strict=True):
        expected = np.sort(dist[dist <= r])[:n_n]  # on the grid distances of exactly r occur
        m = len(expected)
        assert_allclose(dist[row[:m]], expected, rtol=1e-6, atol=1e-6)  # nearest first
        assert len(set(row[:m])) == m and dist[row].min() == 0 and len(row) == n_n
        assert_array_equal(row[m:], c)  # padded with the centroid


@pytest.mark.parametrize("r", [0.1, 0.3, 1.0, 4.0, 8.0])
def test_the_radius_of_a_ball_is_inclusive(r):
    beyond = np.nextafter(np.nextafter(r, np.inf), np.inf)
    xyz = np.array([[0, 0, 0], [r, 0, 0], [0, beyond, 0]])
    assert_array_equal(group_ball(xyz, np.array([0]), r, 3), [[0, 1, 0]])


@given(SEED, KINDS, st.integers(1, 12) | st.integers(1, 300), st.integers(1, 16))
def test_group_knn_equals_brute_force(seed, kind, N, k):
    rng = generator(seed)
    xyz, query = random_points(rng, kind, N), random_points(rng, kind, 20)
    D = cdist(query.astype(float), xyz.astype(float))
    for dist, row in zip(D, group_knn(xyz, query, k), strict=True):
        assert_allclose(dist[row[:N]], np.sort(dist)[:k], rtol=1e-12, atol=1e-12)
        assert len(set(row[:N])) == min(k, N) and len(row) == k
        assert_array_equal(row[N:], row[0])  # fewer than k points: the nearest is repeated


@given(SEED, KINDS, st.integers(1, 60), st.integers(1, 70))
def test_knn_by_matrix_equals_group_knn(seed, kind, N, k):
    rng = generator(seed)
    clouds = [(random_points(rng, kind, N), random_points(rng, kind, 20)) for _ in range(2)]
    xyz, query = (torch.from_numpy(np.stack(part)) for part in zip(*clouds))
    for (y, x), rows in zip(clouds, d3dlo.knn_by_matrix(query, xyz, k), strict=True):
        D = cdist(x.astype(float), y.astype(float))
        expected = np.take_along_axis(D, group_knn(y, x, k), 1)
        got = np.take_along_axis(D, rows.numpy(), 1)
        assert_allclose(got, expected, atol=1e-4)
        assert all(len(set(row.tolist())) == min(k, N) for row in rows)
        assert (rows[:, N:] == rows[:, :1]).all() and rows.shape == (20, k)


@given(SEED)
def test_scan_geometry_samples_and_groups_the_usable_points(seed):
    rng = generator(seed)
    usable = random_scan(rng, 200)
    too_far = [0, 50.1, 0, 0]
    junk = np.float32([[np.nan, 0, 0, 0], [0, np.inf, 0, 0], [1, 1, 1, np.nan], too_far,
                       [1e30, 0, 0, 0]])
    scan = np.insert(usable, rng.integers(1, 200, len(junk)), junk, axis=0)
    g, xyz = scan_geometry(scan, SMALL), usable[:, :3]
    assert g["broken"] == 4  # a point that is only too far away is not invalid

    centroids = fps_textbook(xyz, 32)
    assert_array_equal(g["xyz"], xyz[centroids])
    neighbours = usable[group_ball(xyz, centroids, 2.0, 4)]
    offsets = neighbours[..., :3] - xyz[centroids][:, None]
    assert_array_equal(g["group_sa1"], np.concatenate([neighbours[..., 3:], offsets], -1))
    assert_array_equal(g["idx_sa2"], group_ball(xyz[centroids], np.arange(16), 4.0, 8))
    assert_array_equal(g["idx_sa3"], group_ball(xyz[centroids[:16]], np.arange(8), 8.0, 4))

    z = xyz[:, 2]
    fullest = max(((z >= low) & (z < low + 0.3)).sum() for low in np.arange(-10, 10) * 0.3)
    distances = np.sqrt(np.square(g["xyz"]).sum(1))
    expected = [200, usable[:, 3].mean(), np.median(distances), fullest / 200]
    assert_allclose(g["stats"], expected, rtol=0.02)


# ------------------------------------------------------------------------------------------------
# Motions


def euler_pose(v):
    """The pose (4,4) of x, y, z [m], roll, pitch, yaw [degrees], written out."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(np.radians(v[3:])), np.sin(np.radians(v[3:]))
    Rx = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    Ry = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    Rz = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    T = np.eye(4)
    T[:3, :3] = Rz @ Ry @ Rx
    T[:3, 3] = v[:3]
    return T


@given(SEED, st.lists(st.integers(0, 5), max_size=3))
@settings(max_examples=100)
def test_vectors_of_any_leading_shape_are_extrinsic_xyz_and_survive_the_round_trip(seed, shape):
    v = generator(seed).uniform(-1, 1, (*shape, 6)) * [100, 100, 100, 179.9, 89, 179.9]
    T = from_vector(v)
    expected = np.reshape([euler_pose(row) for row in v.reshape(-1, 6)], (*shape, 4, 4))
    assert_allclose(T, expected, atol=1e-12)
    assert_allclose(to_vector(T), v, atol=1e-7)
    assert_allclose(invert(T), np.linalg.inv(T), atol=1e-11)


@given(SEED, st.sampled_from([90, -90]), st.sampled_from([0, 1e-12, 1e-9, 1e-7, 1e-5, 1e-3, 0.1]))
@settings(max_examples=150)
def test_motions_survive_the_round_trip_at_gimbal_lock_without_a_warning(seed, pole, off):
    roll, yaw = generator(seed).uniform(-179.9, 179.9, 2)
    T = euler_pose(np.array([1, 2, 3, roll, pole - np.sign(pole) * off, yaw]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert_allclose(from_vector(to_vector(T)), T, atol=1e-6)


@given(SEED)
def test_camera_and_velodyne_motions_move_a_point_to_the_same_place(seed):
    rng = generator(seed)
    T = random_motion(rng, [5, 5, 5, 60, 60, 60], n=7)
    Tr = random_motion(rng, [1, 1, 1, 90, 60, 90])
    q = rng.normal(size=(10, 3))
    T_cam = kitti.velo_to_camera(T, Tr)
    assert_allclose(kitti.camera_to_velo(T_cam, Tr), T, atol=1e-12)
    for velo, cam in zip(T, T_cam):  # change the frame, then move; or move, then change it
        assert_allclose(transform(cam, transform(Tr, q)), transform(Tr, transform(velo, q)),
                        atol=1e-12)


# ------------------------------------------------------------------------------------------------
# The network


def count(module):
    """Number of parameters to learn."""
    return sum(p.numel() for p in module.parameters() if p.requires_grad)


def test_table_1_has_61290_parameters():
    blocks = {"sa1": 868, "fe": 4480, "sa2": 8768, "sa3": 8768, "mpn": 21440, "mlp": 16966}
    net = D3DLO()
    assert {name: count(block) for name, block in net.named_children()} == blocks
    assert count(net) == 61290


def test_the_default_config_is_that_of_the_paper():
    table_1 = {"sa1": Layer(1.0, 1024, 8, (4, 8, 16, 32)), "fe": Layer(None, None, 16, (32, 64)),
               "sa2": Layer(4.0, 256, 32, (64, 64)), "sa3": Layer(8.0, 64, 8, (64, 64)),
               "mpn": Layer(None, None, None, (64, 256)), "mlp": Layer(None, None, None, (64, 6))}
    section_4 = dict(epochs=500, optimizer="adam", schedule="steps", swap="random", max_range=None,
                     plane=True, augment=False, frozen=0)
    default = vars(Config())
    assert table_1.items() | section_4.items() <= default.items()
    assert default.keys() - (table_1 | section_4).keys() == {"batch", "lr"}  # not in the paper
    adam, = d3dlo.make_optimizers(D3DLO(), d3dlo.UnweightedLoss())
    assert type(adam) is torch.optim.Adam
    assert adam.defaults == torch.optim.Adam([torch.zeros(1)]).defaults  # "with default values"


class OnlyOnMeta(torch.utils._python_dispatch.TorchDispatchMode):
    """Fail if an operation returns a tensor on another device."""

    def __torch_dispatch__(self, function, types, arguments=(), options=None):
        result = function(*arguments, **options or {})
        for tensor in torch.utils._pytree.tree_leaves(result):
            assert not isinstance(tensor, torch.Tensor) or tensor.is_meta, function
        return result


@pytest.mark.parametrize("training", [True, False])
def test_all_tensors_are_made_on_the_device_of_the_input(training):
    geometry, motions = pairs_of_scans(generator(0), 3)
    p, q = np.array([0, 2, 5]), np.array([1, 3, 4])
    batch = d3dlo.make_batch(np.concatenate(geometry), p, q, SMALL, "meta")
    net = d3dlo.for_device(D3DLO(SMALL), "meta").train(training)
    assert type(net.sa1) is d3dlo.SetAbstraction and all(part.is_meta for part in batch)
    with OnlyOnMeta():
        y_hat = net(batch)
        d3dlo.UnweightedLoss()(y_hat, torch.empty_like(y_hat)).backward()
    assert y_hat.shape == (3, 6) and net.sa1.mpn.h[0].weight.grad.is_meta


CONFIGS = {
    "small": SMALL,
    "one neighbour": replace(SMALL, sa1=SMALL.sa1._replace(n_n=1), fe=SMALL.fe._replace(n_n=1),
                             sa2=SMALL.sa2._replace(n_n=1)),
    # All neighbours are copies of the centroid, so every maximum is a tie
    "centroids alone": replace(SMALL, swap="random", sa3=SMALL.sa3._replace(r=0.1)),
    "more neighbours than points": replace(SMALL, fe=SMALL.fe._replace(n_n=40),
                                           sa3=SMALL.sa3._replace(n_n=20)),
}


def compare_fast_and_plain(net, batch, training, rng):
    """Assert that `d3dlo.fast(net)` has the predictions, gradients and statistics of the plain net.

    Returns the predictions and the two networks, fast and plain.
    """
    plain, fast = copy.deepcopy(net).train(training), d3dlo.fast(net).train(training)
    expected, got = plain(batch), fast(batch)
    torch.testing.assert_close(got, expected, rtol=1e-9, atol=1e-9)
    y_hat = got
    weights = torch.from_numpy(rng.normal(size=expected.shape))
    names, parameters = zip(*net.named_parameters())  # `fast` shares them
    expected = torch.autograd.grad((expected * weights).sum(), [*plain.parameters()])
    got = torch.autograd.grad((got * weights).sum(), parameters)
    expected, got = dict(zip(names, expected, strict=True)), dict(zip(names, got, strict=True))
    torch.testing.assert_close(got, expected, rtol=1e-6, atol=1e-8)
    torch.testing.assert_close(net.state_dict(), plain.state_dict(), rtol=1e-9, atol=1e-9)
    return y_hat, fast, plain


@table("config", CONFIGS)
@pytest.mark.parametrize("training", [True, False])
@given(seed=SEED)
def test_the_fast_network_equals_the_plain_one(training, config, seed):
    rng = generator(seed)
    net, batch = random_net(rng, config).double(), in_double(random_batch(rng, config)[0])
    y_hat, fast, plain = compare_fast_and_plain(net, batch, training, rng)
    assert y_hat.std(0).min() > 1e-3  # predictions of different pairs differ
    # They share only the types of layers that `fast` does not replace
    assert {type(m) for m in fast.modules()} & {type(m) for m in plain.modules()} == {
        D3DLO, torch.nn.Sequential, torch.nn.Linear, torch.nn.BatchNorm1d, torch.nn.ReLU}


def by_the_equations(net, batch):
    """The predictions by eqs. 3 and 4, in eval mode, with a loop over centroids and neighbours."""
    def h(mpn, *parts):
        return mpn.h(torch.cat(parts)[None])[0]

    def maximum(features):
        return torch.stack(features).max(0).values

    def eq_3(sa, x, f, idx):
        out = []
        for j, neighbours in enumerate(idx):
            out.append(maximum([h(sa.mpn, f[i], x[i] - x[j]) for i in neighbours]))
        return x[:len(idx)], torch.stack(out)

    def eq_4(fe, x, f, y, g):
        distances = torch.cdist(x, y, compute_mode="donot_use_mm_for_euclid_dist")
        nearest = distances.topk(net.config.fe.n_n, largest=False).indices
        out = []
        for i, neighbours in enumerate(nearest):
            out.append(maximum([h(fe.mpn, f[i], g[j], y[j] - x[i]) for j in neighbours]))
        return torch.stack(out)

    def first_features(scan):  # eq. 3 for SA1, whose groups hold features and offsets already
        groups = batch.group_sa1[scan]
        return torch.stack([maximum([h(net.sa1.mpn, point) for point in ball]) for ball in groups])

    out = []
    for p, q in zip(batch.p, batch.q):
        x, y = batch.xyz[p], batch.xyz[q]
        e = eq_4(net.fe, x, first_features(p), y, first_features(q))
        x, e = eq_3(net.sa2, x, e, batch.idx_sa2[p])
        x, e = eq_3(net.sa3, x, e, batch.idx_sa3[p])
        global_feature = maximum([h(net.mpn, e_i) for e_i in e])
        out.append(net.mlp(global_feature[None])[0])
    return torch.stack(out)


@given(seed=SEED)
@settings(max_examples=5)
def test_the_plain_network_follows_equations_3_and_4(seed):
    rng = generator(seed)
    net, batch = random_net(rng).double(), in_double(random_batch(rng, pairs=1)[0])
    torch.testing.assert_close(net(batch), by_the_equations(net, batch), rtol=1e-9, atol=1e-9)


@given(SEED, st.booleans())
def test_linear_max_divides_its_gradient_among_ties_as_amax_does(seed, moments):
    rng = generator(seed)
    h, W = (torch.from_numpy(rng.integers(-1, 2, shape).astype(float)).requires_grad_()
            for shape in ((2, 3, 6, 3), (4, 3)))  # integers, so that ties are exact
    fast, slow = d3dlo.LinearMax.apply(h, W, moments)[0], (h @ W.t()).amax(2)
    torch.testing.assert_close(fast, slow, rtol=0, atol=0)
    grad = torch.from_numpy(rng.normal(size=fast.shape))
    got, expected = (torch.autograd.grad(y, (h, W), grad) for y in (fast, slow))
    torch.testing.assert_close(got, expected)


@given(SEED)
def test_no_gradient_is_lost_when_the_backward_pass_rounds_the_product_differently(seed):
    rng = generator(seed)
    h, W = (torch.from_numpy(rng.normal(size=shape)).requires_grad_()
            for shape in ((2, 3, 6, 3), (4, 3)))
    out = d3dlo.LinearMax.apply(h, W, False)[0]
    mm = torch.mm

    def slightly_larger(a, b, out):
        return mm(a, b, out=out).mul_(1 + 1e-12)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch, "mm", slightly_larger)
        grad_h, = torch.autograd.grad(out.sum(), h)
    expected, = torch.autograd.grad((h @ W.t()).amax(2).sum(), h)
    torch.testing.assert_close(grad_h, expected)


@pytest.mark.parametrize("momentum", [0.1, 0.0, 1.0, None])
def test_the_fast_network_updates_running_statistics_with_every_momentum(momentum):
    rng = generator(0)
    net = random_net(rng)
    for norm in batch_norms(net):
        norm.momentum = momentum
    plain, fast, batch = copy.deepcopy(net).train(), d3dlo.fast(net).train(), random_batch(rng)[0]
    plain(batch)
    fast(batch)
    torch.testing.assert_close(net.state_dict(), plain.state_dict(), rtol=1e-4, atol=1e-5)


def test_recomputed_statistics_are_the_means_over_batches():
    rng = generator(0)
    net, batches = random_net(rng), [random_batch(rng) for _ in range(3)]
    statistics = []
    for batch, _ in batches:
        alone = copy.deepcopy(net).train()
        for norm in batch_norms(alone):
            norm.momentum = 1  # the statistics of this batch alone
        alone(batch)
        statistics.append([(norm.running_mean, norm.running_var) for norm in batch_norms(alone)])
    update_bn(iter(batches), d3dlo.fast(net))  # pairs of a Batch and poses, as in `fit`
    for norm, of_batches in zip(batch_norms(net), zip(*statistics), strict=True):
        mean, var = (torch.stack(part).mean(0) for part in zip(*of_batches))
        torch.testing.assert_close((norm.running_mean, norm.running_var), (mean, var),
                                   rtol=1e-3, atol=1e-4)


@given(SEED)
def test_the_loss_is_equation_2(seed):
    y, y_hat = (torch.from_numpy(generator(seed + i).normal(size=(4, 6))) for i in range(2))
    torch.testing.assert_close(d3dlo.UnweightedLoss()(y_hat, y), F.l1_loss(y_hat, y))


# ------------------------------------------------------------------------------------------------
# Training


@pytest.mark.parametrize("frozen", [0, 0.25])
def test_the_network_can_overfit_sixteen_pairs(tmp_path, frozen):
    geometry, motions = pairs_of_scans(generator(0), 16)
    config = replace(SMALL, epochs=300, lr=1e-2, schedule="one-cycle", frozen=frozen)
    log = []
    torch.manual_seed(0)
    net = d3dlo.fit(D3DLO(config), geometry, motions, tmp_path, say=log.append, **FACTS)
    first, last, in_eval_mode = (float(re.search(r"[\d.]{6}", log[i])[0]) for i in (0, -2, -1))
    assert first > 0.3 and last < 0.02 and in_eval_mode < 0.02  # eq. 2, metres and degrees alike
    got = to_vector(np.concatenate([d3dlo.predict_motions(net, records) for records in geometry]))
    assert np.abs(got - to_vector(np.concatenate(motions))).mean() < 0.02


@given(SEED, st.sampled_from(["both", "random"]), st.booleans(), st.integers(2, 12))
def test_batches_depend_on_seed_and_step_alone(seed, swap, augmented, batch):
    config = replace(SMALL, swap=swap, augment=augmented, batch=batch)
    geometry, motions = random_sequences()

    def bytes_of_batches(seed, start, stop):
        batches = d3dlo.batches(geometry, motions, config, (seed,), start, stop)
        return [b"".join(np.asarray(part).tobytes() for part in (*batch, T))
                for batch, T in batches]

    steps = 2 * d3dlo.steps_per_epoch(motions, config)  # two epochs
    whole = bytes_of_batches(seed, 0, steps)
    for start in (0, 1, steps // 2, steps - 1):
        assert bytes_of_batches(seed, start, steps) == whole[start:]
    assert bytes_of_batches(seed + 1, 0, 1) != whole[:1]
    # Augmentation is drawn anew in each epoch: here two epochs of the same two pairs
    two = d3dlo.batches([geometry[0][:3]], [motions[0][:2]], config, (seed,), 0, 2)
    assert not augmented or len({T.tobytes() for _, T in two}) == 2


@given(SEED, st.sampled_from(["both", "random"]), st.integers(2, 12))
def test_an_epoch_has_every_pair_once_with_the_motion_in_its_direction(seed, swap, batch):
    config = replace(SMALL, swap=swap, batch=batch)
    geometry, motions = random_sequences()
    scan_of = {}  # (sequence, scan) of each scan, by its points
    for s, records in enumerate(geometry):
        for i, record in enumerate(records):
            scan_of[record["xyz"].tobytes()] = s, i

    seen = []
    steps = d3dlo.steps_per_epoch(motions, config)
    for b, T_pq in d3dlo.batches(geometry, motions, config, (seed,), 0, steps):
        assert len(T_pq) >= min(batch, 10)  # no smaller batch at the end
        for p, q, T in zip(b.p, b.q, T_pq, strict=True):
            (s, i), (s_q, j) = (scan_of[b.xyz[c].numpy().tobytes()] for c in (p, q))
            assert s == s_q and abs(i - j) == 1
            expected = motions[s][min(i, j)]
            assert_allclose(T, expected if i < j else np.linalg.inv(expected), atol=1e-9)
            seen.append((s, min(i, j), i < j))
        if swap == "both":  # both directions are in one batch
            assert 2 * len({pair[:2] for pair in seen}) == len(seen)

    every_pair = [(s, i) for s in range(2) for i in range(5)]
    assert sorted({pair[:2] for pair in seen}) == every_pair
    assert len(seen) == len(set(seen)) == (20 if swap == "both" else 10)
    if swap == "both":
        assert {forward for *_, forward in seen} == {True, False}


def test_the_direction_of_a_pair_is_random():
    geometry, motions = random_sequences()
    config = replace(SMALL, swap="random", batch=10)
    batches = d3dlo.batches(geometry, motions, config, (0,), 0, 40)
    forward = [(b.p[0] < b.q[0]).item() for b, _ in batches]
    assert 8 < sum(forward) < 32  # 20 are expected, with a standard deviation of 3


@pytest.mark.parametrize("batch, pairs", [(1, 10), (16, 1)])
def test_batches_of_one_pair_in_one_direction_are_refused(batch, pairs):
    with pytest.raises(ValueError, match="at least 2"):
        d3dlo.steps_per_epoch([np.zeros((pairs, 4, 4))], replace(SMALL, swap="random", batch=batch))


@given(SEED)
def test_augmented_pairs_still_fit_their_motion(seed):
    rng = generator(seed)
    geometry, motions = pairs_of_scans(rng, 6, points=200, config=SMALL)
    for p, q in geometry:  # Q is P moved: the same points in the same order
        assert_array_equal(p["idx_sa2"], q["idx_sa2"])
    before, T = np.stack([g[d] for d in (0, 1) for g in geometry]), np.concatenate(motions)
    aligned = np.array([True, False] * 3)
    scans, T_new = d3dlo.augment(before, T, aligned, rng)
    for p, q, old, X, Y in zip(scans[:6], scans[6:], before[:6], T_new, T):
        assert_allclose(transform(X, q["xyz"]), p["xyz"], atol=1e-4)
        near_p, near_q = (c["xyz"][:, None] + c["group_sa1"][..., 1:] for c in (p, q))
        assert_allclose(transform(X, near_q), near_p, atol=1e-4)
        assert np.linalg.det(X[:3, :3]) > 0.999  # no reflection is left
        assert np.abs(X - Y).max() > 1e-3  # something moved
        left_to_right = np.sign(p["xyz"][0, 1] * old["xyz"][0, 1])
        assert_array_equal(p["xyz"] * [1, left_to_right, 1], old["xyz"])
    # Only the coordinates have changed
    before["xyz"], before["group_sa1"][..., 1:] = scans["xyz"], scans["group_sa1"][..., 1:]
    assert before.tobytes() == scans.tobytes()


def test_augmentation_mirrors_half_of_the_pairs_and_aligns_those_asked_for():
    n, rng = 2000, generator(0)
    far = euler_pose(np.array([100, 40, 0, 0, 0, 90.0]))  # larger than any residual motion
    scans = np.zeros(2 * n, d3dlo.geometry_dtype(replace(SMALL, sa1=SMALL.sa1._replace(n_fps=16))))
    scans["xyz"][:] = 1
    aligned = rng.random(n) < 0.3
    moved, T = d3dlo.augment(scans, np.tile(far, (n, 1, 1)), aligned, rng)
    p = moved["xyz"][:n, 0]
    assert_array_equal(np.unique(p, axis=0), [[1, -1, 1], [1, 1, 1]])  # half of them, left to right
    mirrored = p[:, 1] < 0
    assert abs(mirrored.mean() - 0.5) < 0.05
    mirror = np.diag([1, -1, 1, 1])
    for chosen, base in ((aligned, np.eye(4)), (~aligned & mirrored, mirror @ far @ mirror),
                         (~aligned & ~mirrored, far)):
        A = to_vector(invert(T[chosen]) @ base)  # Q moves after it has been aligned
        assert_allclose(A.mean(0), 0, atol=0.15)
        assert_allclose(A.std(0), [0.25, 0.1, 0.03, 0.1, 0.1, 1.0], rtol=0.15)


@given(SEED)
def test_a_later_scan_is_the_next_one_or_within_the_distance_of_keyframes(seed):
    rng = generator(seed)
    motions = random_motion(rng, n=12) * 1.0
    motions[:, :3, 3] *= rng.choice([0, 1, 4], (12, 1))  # [m]; some stand still, some are far
    i, drawn = int(rng.integers(12)), set()
    for _ in range(200):
        drawn.add(d3dlo.later_scan(motions, i, rng))
    metres, within = 0.0, {i + 1}
    for j in range(i, 12):
        metres += np.linalg.norm(motions[j, :3, 3])
        if metres < d3dlo.KEYFRAME_DISTANCE:
            within.add(j + 1)
    # A scan is left out where the next one is at the same place
    still = {j for j in within if j < 12 and not motions[j, :3, 3].any() and j + 1 in within}
    assert drawn <= within and len(within - still) >= len(drawn - still)


def test_a_share_of_augmented_pairs_are_several_scans_apart_and_aligned():
    """Scans of a static world, each with its number for an intensity, which nothing changes."""
    rng = generator(0)
    motions = random_motion(rng, n=30)
    motions[:, :3, 3] *= 1.2 / np.linalg.norm(motions[:, :3, 3], axis=1)[:, None]  # as on a road
    world, poses = random_scan(rng, 60), d3dlo.accumulate(motions)
    first = scan_geometry(world, SMALL)
    records = d3dlo.move_scans(np.stack([first] * 31), invert(poses))
    records["group_sa1"][..., 0] = np.arange(31)[:, None, None]
    config = replace(SMALL, swap="both", augment=True)
    pairs, gaps, residuals = [(0, i) for i in range(26)], [], []
    for _ in range(40):
        batch, T = d3dlo.training_batch([records], [motions], pairs, config, rng)
        numbers = batch.group_sa1[:, 0, 0, 0].numpy()
        for p, q, T_pq in zip(batch.p[:26], batch.q[:26], T):
            assert_allclose(transform(T_pq, batch.xyz[q].numpy()), batch.xyz[p], atol=1e-3)
            gaps.append(numbers[q] - numbers[p])
            residuals.append(np.linalg.norm(T_pq[:3, 3]))
    gaps, residuals = np.array(gaps), np.array(residuals)
    assert set(gaps) == {1, 2, 3, 4}  # 4.8 m at most
    assert abs((gaps > 1).mean() - d3dlo.ALIGNED * (5 - 2.4) / 5) < 0.05
    assert np.all(residuals[gaps > 1] < 1.2)  # aligned up to a small motion
    assert (residuals > 0.6).mean() > 0.5  # most others are not


def fit(folder, config, resume=None, test=None, say=None):
    """Train on `random_sequences()` until the end or an interruption. Returns the log."""
    log = []
    torch.manual_seed(0 if resume is None else 99)  # a resumed net must not depend on its start
    with contextlib.suppress(KeyboardInterrupt, BrokenPipeError):
        d3dlo.fit(D3DLO(config), *random_sequences(), folder, 7, "cpu", resume, say or log.append,
                  test=test, **FACTS)
    return log


def stored(folder, name="weights.pt"):
    return torch.load(folder / name, weights_only=True)


def assert_same_model(a, b):
    """Assert that two weights files or checkpoints are equal bit by bit."""
    assert a["step"] == b["step"] and a["model"].keys() == b["model"].keys()
    assert all(torch.equal(tensor, b["model"][name]) for name, tensor in a["model"].items())


def signal_handlers():
    """The handlers of the two signals that interrupt training."""
    return [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]


# Training stops in the eighth of 15 steps, in the middle of an epoch. KeyboardInterrupt ends the
# step at once, so the last checkpoint is from step 7. A signal lets the step finish.
@pytest.mark.parametrize("stop, last_step, schedule, optimizer, frozen", [
    (KeyboardInterrupt, 7, "steps", "adam", 0),
    (KeyboardInterrupt, 7, "one-cycle", "muon", 8 / 15),
    (signal.SIGINT, 8, "steps", "adam", 7 / 15),
    (signal.SIGTERM, 8, "one-cycle", "muon", 0.6)])
def test_resuming_a_stopped_or_finished_run_gives_the_weights_of_an_uninterrupted_one(
        tmp_path, monkeypatch, stop, last_step, schedule, optimizer, frozen):
    config = replace(SMALL, epochs=5, batch=3, schedule=schedule, optimizer=optimizer,
                     augment=True, frozen=frozen)
    whole, handlers = fit(tmp_path / "whole", config), signal_handlers()
    steps, forward = [], d3dlo.UnweightedLoss.forward

    def stop_in_step_8(*arguments):
        steps.append(1)
        if len(steps) == 8:
            if stop is KeyboardInterrupt:
                raise KeyboardInterrupt
            os.kill(os.getpid(), stop)
        return forward(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(d3dlo.UnweightedLoss, "forward", stop_in_step_8)
        patch.setattr(d3dlo, "STORE_EVERY", 0)  # a checkpoint after each step
        part = fit(tmp_path / "part", config)
    assert len(steps) == 8 and stored(tmp_path / "part", "checkpoint.pt")["step"] == last_step
    assert handlers == signal_handlers()
    for log in (part, whole[:-1]):  # resume the stopped run; then resume it when it is finished
        checkpoint = stored(tmp_path / "part", "checkpoint.pt")
        assert log + fit(tmp_path / "part", config, checkpoint) == whole
        for name in ("checkpoint.pt", "weights.pt"):
            a, b = stored(tmp_path / "whole", name), stored(tmp_path / "part", name)
            assert a["step"] == 15
            assert_same_model(a, b)


def test_ctrl_c_after_the_last_step_ends_the_training_with_complete_weights(tmp_path, monkeypatch):
    store_weights = d3dlo.Training.store_weights

    def press_ctrl_c(training, net):
        os.kill(os.getpid(), signal.SIGINT)
        store_weights(training, net)

    monkeypatch.setattr(d3dlo.Training, "store_weights", press_ctrl_c)
    handlers, config = signal_handlers(), replace(SMALL, epochs=2, batch=3)
    with pytest.raises(KeyboardInterrupt, match=r"the weights are complete: .*weights\.pt"):
        d3dlo.fit(D3DLO(config), *random_sequences(), tmp_path)
    assert handlers == signal_handlers()
    assert stored(tmp_path)["step"] == stored(tmp_path, "checkpoint.pt")["step"] == 6


@table("error", {"the reader of stdout has gone": BrokenPipeError, "a bug": ZeroDivisionError})
def test_an_exception_between_two_steps_leaves_a_checkpoint(tmp_path, error):
    config = replace(SMALL, epochs=4, batch=3, augment=True)

    def say(line):
        part.append(line)
        if "epoch 2" in line:
            raise error

    whole, part = fit(tmp_path / "whole", config), []
    with contextlib.suppress(ZeroDivisionError):
        fit(tmp_path / "part", config, say=say)
    checkpoint = stored(tmp_path / "part", "checkpoint.pt")
    assert checkpoint["step"] == 6 and os.listdir(tmp_path / "part") == ["checkpoint.pt"]
    assert part + fit(tmp_path / "part", config, checkpoint) == whole
    assert_same_model(stored(tmp_path / "part"), stored(tmp_path / "whole"))


@table("owner, name", {"the loss": (d3dlo.UnweightedLoss, "forward"),
                       "the backward pass": (torch.Tensor, "backward"),
                       "the optimiser": (torch.optim.Adam, "step")})
def test_an_exception_within_a_step_leaves_the_previous_checkpoint(
        tmp_path, monkeypatch, owner, name):
    config, done, before = replace(SMALL, epochs=4, batch=3), [], []

    def work_and_fail(*arguments, work=getattr(owner, name), **options):
        done.append(work(*arguments, **options))
        if len(done) == 5:
            before.append((tmp_path / "part" / "checkpoint.pt").read_bytes())
            raise MemoryError
        return done[-1]

    fit(tmp_path / "whole", config)
    with monkeypatch.context() as patch:
        patch.setattr(owner, name, work_and_fail)
        patch.setattr(d3dlo, "STORE_EVERY", 0)  # a checkpoint after each step
        with pytest.raises(MemoryError):
            fit(tmp_path / "part", config)
    assert before == [(tmp_path / "part" / "checkpoint.pt").read_bytes()]
    checkpoint = stored(tmp_path / "part", "checkpoint.pt")
    assert checkpoint["step"] == 4
    fit(tmp_path / "part", config, checkpoint)
    assert_same_model(stored(tmp_path / "part"), stored(tmp_path / "whole"))


@pytest.mark.parametrize("tested", [False, True])
@pytest.mark.parametrize("epochs, batch", [(50, 3), (1, 10)])  # (1, 10): at the last step
def test_a_training_run_that_diverges_says_so_and_stores_no_nan(tmp_path, tested, epochs, batch):
    config = replace(SMALL, epochs=epochs, batch=batch, lr=1e30)
    with pytest.raises(ValueError, match=r"non-finite at step [1-9] \(learning rate 1\.0e\+"):
        fit(tmp_path, config, test=random_sequences() if tested else None)
    assert not any(tmp_path.iterdir())


def test_the_learning_rate_drops_to_a_tenth_at_epochs_300_and_400_of_500(tmp_path):
    optimizer, rates = torch.optim.SGD([torch.zeros(1)]), []
    optimizer.param_groups[0]["lr"] = 1.0
    scheduler = d3dlo.make_scheduler(optimizer, Config(), 500 * 2)  # 2 steps an epoch
    for _ in range(500 * 2):
        rates.append(scheduler.get_last_lr()[0])
        optimizer.step()
        scheduler.step()
    assert_allclose(rates, [1.0] * 600 + [0.1] * 200 + [0.01] * 200)
    log = fit(tmp_path, replace(SMALL, epochs=10, batch=5, lr=0.002))
    rates = re.findall(r"learning rate (\S+)", "\n".join(log))
    assert rates == ["2.0e-03"] * 6 + ["2.0e-04"] * 2 + ["2.0e-05"] * 2


@pytest.mark.parametrize("frozen", [0, 0.5])
def test_running_statistics_are_recomputed_at_the_end_unless_frozen(tmp_path, frozen):
    geometry, motions = random_sequences()
    # Each batch holds all 10 pairs, so all batches have the same statistics
    config = replace(SMALL, epochs=6, batch=10, lr=1e-2, frozen=frozen)
    fit(tmp_path, config)
    weights, checkpoint = (stored(tmp_path, f"{name}.pt")["model"]
                           for name in ("weights", "checkpoint"))
    if frozen:  # the weights were trained with these statistics
        assert all(torch.equal(tensor, checkpoint[name]) for name, tensor in weights.items())
        return
    net = D3DLO(config).train()
    net.load_state_dict(weights)
    for norm in batch_norms(net):
        norm.momentum = 1  # the statistics of the last batch alone
    pairs = [(s, i) for s in range(2) for i in range(5)]
    net(d3dlo.training_batch(geometry, motions, pairs, config, None)[0])
    means = [name for name in weights if name.endswith("running_mean")]
    for name in means:
        torch.testing.assert_close(weights[name], net.state_dict()[name], rtol=1e-3, atol=1e-3)
    assert max((weights[name] - checkpoint[name]).abs().max() for name in means) > 0.05


def test_muon_trains_the_hidden_matrices_with_steps_as_large_as_adams():
    torch.manual_seed(0)
    net = D3DLO(replace(SMALL, optimizer="muon"))
    adam, muon = d3dlo.make_optimizers(net, d3dlo.UnweightedLoss())
    matrices = [m.weight for m in net.modules() if isinstance(m, torch.nn.Linear)][:-1]
    assert {*muon.param_groups[0]["params"]} == {*matrices}
    assert {*adam.param_groups[0]["params"]} == {*net.parameters()} - {*matrices}
    before = [W.detach().clone() for W in matrices]
    for W in matrices:
        W.grad = torch.zeros_like(W)
    muon.step()
    assert all(map(torch.equal, matrices, before))  # no gradient, no step: no weight decay
    for W in matrices:
        W.grad = torch.randn_like(W)
    muon.step()
    for W, old in zip(matrices, before):
        size = (W - old).square().mean().sqrt() / net.config.lr
        assert 0.1 < size < 0.3  # like Adam's, about 0.2 (Liu et al., "Muon is scalable")


TEST_LOSS = re.compile(r", test loss (\d+\.\d{4})")


@table("config", {
    "short": replace(SMALL, epochs=4, batch=3, augment=True, optimizer="muon",
                     schedule="one-cycle", frozen=0.25),
    "the paper's": replace(SMALL, epochs=4, batch=3, swap="random")})
def test_the_test_loss_is_logged_once_an_epoch_and_does_not_affect_training(tmp_path, config):
    test = pairs_of_scans(generator(1), 9)
    alone, whole = fit(tmp_path / "alone", config), fit(tmp_path / "whole", config, test=test)
    for name in ("weights.pt", "checkpoint.pt"):
        assert_same_model(stored(tmp_path / "alone", name), stored(tmp_path / "whole", name))
    assert [TEST_LOSS.sub("", line) for line in whole] == alone
    assert [len(TEST_LOSS.findall(line)) for line in whole] == [1] * 4 + [0]

    # The last one is the loss of the stored weights over both directions of all pairs
    net, errors = load_weights(tmp_path / "whole")[0], []
    for records, T in zip(*test):
        for pair, motions in ((records, T), (records[::-1], invert(T))):
            errors.append(to_vector(d3dlo.predict_motions(net, pair)) - to_vector(motions))
    last = float(TEST_LOSS.search(whole[3])[1])
    assert last == pytest.approx(np.abs(errors).mean(), abs=1e-4)

    def stop(line):
        part.append(line)
        if "epoch 2" in line:
            raise KeyboardInterrupt

    part = []
    fit(tmp_path / "part", config, test=test, say=stop)
    checkpoint = stored(tmp_path / "part", "checkpoint.pt")
    assert part + fit(tmp_path / "part", config, checkpoint, test) == whole


@given(st.integers(1, 2000), st.integers(1, 2000))
@settings(max_examples=10)
def test_the_test_loss_uses_at_most_500_fixed_pairs_spread_over_all_sequences(n, m):
    def pairs(net):  # the "records" of scans are their numbers
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(d3dlo, "training_batch", lambda *arguments: (arguments[2], None))
            parts = d3dlo.test_examples(None, [range(n), range(m)], SMALL, "cpu")
            return [tuple(pair) for part, _ in parts for pair in part.tolist()]

    chosen = pairs(0)
    everything = [(0, i) for i in range(n)] + [(1, i) for i in range(m)]
    assert len(chosen) == len(set(chosen)) == min(500, n + m) and chosen == pairs(1)
    gaps = np.diff([everything.index(pair) for pair in chosen])
    assert chosen[0] == (0, 0) and chosen[-1] == (1, m - 1)
    assert n + m == 1 or len(set(gaps)) <= 2  # evenly spread


# ------------------------------------------------------------------------------------------------
# Metrics


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


def straight_path(n, step=1.0):
    """Poses (n,4,4) of a camera that moves along z, its viewing direction."""
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, 2, 3] = step * np.arange(n)
    return T


def real_path(file):
    """A function like `random_trajectory` that returns the beginning of real poses."""
    poses = metrics.read_poses(file)
    return lambda rng, n: poses[:n]


DRIVES = {"winding": random_trajectory,
          "straight": lambda rng, n: straight_path(n, 2.5)}  # 100 m are exactly 40 frames
DRIVES |= {f"real {file.stem}": real_path(file)
           for file in sorted(KITTI.glob("poses/*.txt"))[:2]}


@table("drive", DRIVES)
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


@pytest.mark.parametrize(
    "error", [metrics.segment_errors, metrics.step_errors, metrics.absolute_errors])
def test_trajectories_of_different_lengths_are_refused(error):
    with pytest.raises(ValueError, match="20.*19"):
        error(straight_path(20), straight_path(19))


@given(SEED)
def test_absolute_errors_are_distances_and_rmse_is_their_root_mean_square(seed):
    rng = generator(seed)
    T = random_trajectory(rng, 20)
    apart = rng.normal(size=(20, 3)) * [1, 2, 4]
    moved = T.copy()
    moved[:, :3, 3] += apart
    errors = metrics.absolute_errors(T, moved)
    assert_allclose(errors, [math.hypot(*xyz) for xyz in apart], atol=1e-9)
    assert metrics.rmse(errors) ** 2 == pytest.approx(errors.var() + errors.mean() ** 2)


@given(SEED, st.integers(1, 30))
def test_pose_files_survive_the_round_trip(tmp_path, seed, n):
    T, path = random_trajectory(generator(seed), n), tmp_path / "new" / "a.txt"
    metrics.write_poses(path, T)
    assert_allclose(metrics.read_poses(path), T, rtol=1e-8, atol=1e-8)
    assert os.listdir(path.parent) == ["a.txt"] and np.loadtxt(path, ndmin=2).shape == (n, 12)


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
    assert rows.shape == (len(T), 8) and os.listdir(tmp_path) == ["a.tum"]
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
    camera = kitti.velo_to_camera(lidar, Tr)
    for T, labels in ((lidar, ["LiDAR -y, right [m]", "LiDAR x, forward [m]"]),
                      (camera, ["camera x, right [m]", "camera z, forward [m]"])):
        view, *axes = metrics.view_from_above(T)
        assert axes == labels
        assert_allclose(view @ T[:, :3, 3].T, [-lidar[:, 1, 3], lidar[:, 0, 3]], atol=1e-9)


# ------------------------------------------------------------------------------------------------
# Data


@given(SEED, st.floats(-8, 8), st.floats(-8, 8))
def test_remove_plane_removes_the_ground_and_keeps_a_box_in_order(seed, roll, pitch):
    rng = generator(seed)
    ground = np.c_[rng.uniform(-20, 20, (3000, 2)), rng.normal(0, 0.02, 3000), rng.random(3000)]
    box = np.c_[rng.uniform(-8, 8, (1500, 2)), rng.uniform(0.4, 3, 1500), rng.random(1500)]
    tilted = euler_pose(np.array([0, 0, -1.7, roll, pitch, 0]))
    scan = transform_scan(tilted, np.r_[ground, box])
    order = rng.permutation(4502)
    scan = np.r_[scan, np.full((2, 4), np.nan, np.float32)][order]
    kept = scan[order >= 3000]  # the box and the points with NaN
    assert_array_equal(kitti.remove_plane(scan, seed=seed), kept)


def test_remove_plane_removes_points_within_15_cm_of_the_plane():
    rng = generator(0)
    ground = np.c_[rng.uniform(-20, 20, (3000, 2)), np.zeros(3000), rng.random(3000)]
    heights = np.array([-0.17, -0.13, 0.13, 0.17])
    near = np.c_[rng.uniform(-20, 20, (40, 2)), np.repeat(heights, 10), rng.random(40)]
    kept = kitti.remove_plane(np.r_[ground, near].astype(np.float32))
    assert_array_equal(kept, near[np.abs(near[:, 2]) > 0.15].astype(np.float32))


@pytest.mark.parametrize("plane", [True, False])
def test_without_the_plane_no_point_of_the_ground_is_sampled(plane):
    rng = generator(0)
    ground = np.c_[rng.uniform(-20, 20, (3000, 2)), np.full(3000, -1.7), rng.random(3000)]
    scan = np.r_[ground, random_scan(rng, 500) + [0, 0, 3, 0]].astype(np.float32)
    record = scan_geometry(scan, replace(SMALL, plane=plane))
    assert (record["xyz"][:, 2].min() < -1.5) == plane
    assert record["stats"][0] == (3500 if plane else 500)


@pytest.mark.parametrize("N, thick", [(0, 0), (2, 0), (500, 0), (5000, 0.1)])
def test_remove_plane_without_a_ground_plane_changes_nothing(N, thick):
    rng = generator(0)
    x = rng.normal(size=N) * thick
    wall = np.c_[x, rng.uniform(-9, 9, N), rng.uniform(-2, 9, N), rng.random(N)]
    wall = wall.astype(np.float32)
    assert_array_equal(kitti.remove_plane(wall), wall)


def files_of(root):
    """{path relative to root: content} of all files below a folder."""
    paths = [path for path in Path(root).rglob("*") if path.is_file()]
    return {str(path.relative_to(root)): path.read_bytes() for path in paths}


@pytest.fixture(scope="session")
def city(tmp_path_factory):
    """Two simulated sequences of 8 scans, of the training and validation splits. Read only."""
    return kitti.simulate(tmp_path_factory.mktemp("city"), sequences=("00", "07"), scans=8,
                          azimuth=300, workers=1)


def test_simulation_is_the_same_in_any_order_and_with_any_workers_and_keeps_files(city, tmp_path):
    def simulate(to, names, **more):
        root = kitti.simulate(tmp_path / to, sequences=names, scans=8, azimuth=300, **more)
        return files_of(root)

    made, other = files_of(city), simulate("other", ("07",), seed=1)
    assert simulate("two", ("07", "00"), workers=2) == made
    assert len(other) == 12
    for name, data in other.items():
        assert not name.endswith((".bin", "07.txt")) or data != made[name]
    (tmp_path / "two" / SCAN).write_bytes(b"there")
    assert simulate("two", ("00", "07"))[SCAN] == b"there"


def test_simulated_scans_are_in_kittis_layout_and_fit_their_poses(tmp_path):
    root = kitti.simulate(tmp_path, sequences=("02",), scans=3, azimuth=900, workers=1)
    s, = kitti.open_sequences(root)
    assert len(s) == len(s.poses) == 3
    assert_allclose(s.poses[0], np.eye(4), atol=1e-8)
    # Tr is far from the identity, so that confused frames would be noticed
    assert np.abs(s.Tr[:3, :3] - np.eye(3)).max() > 0.9 and np.abs(s.Tr[:3, 3]).max() > 0.1
    for i in range(3):
        scan = s.scan(i)
        assert scan.dtype == np.float32 and len(scan) > 15000 and np.isfinite(scan).all()
        distances = np.linalg.norm(scan[:, :3], axis=1)
        assert 1 < distances.min() and distances.max() < 80.5
        assert 0 <= scan[:, 3].min() and scan[:, 3].max() <= 1
    for i, T in enumerate(s.motions()):
        p, q = s.scan(i)[:, :3], s.scan(i + 1)[:, :3]
        q = q[q[:, 2] > -1.2]  # without the ground, which fits every motion along it
        tree = cKDTree(p)

        def distance(M, q=q, tree=tree):
            return np.median(tree.query(transform(M, q))[0])

        wrong = np.eye(4), invert(T), kitti.velo_to_camera(T, s.Tr)
        assert distance(T) < 0.1 and min(map(distance, wrong)) > 3 * distance(T)


def test_simulated_test_sequences_are_long_and_winding_enough_to_be_evaluated(tmp_path):
    errors, steps = [], []
    root = kitti.simulate(tmp_path, sequences=["test"], azimuth=16, workers=1)
    for s in kitti.open_sequences(root):
        v = to_vector(s.motions())
        steps.append(v)
        without_rotation = d3dlo.accumulate(from_vector(v * [1, 1, 1, 0, 0, 0]))
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


def test_vehicles_around_us_stand_in_a_queue_at_a_light_and_start_with_us():
    world = kitti._world("05", 0, 170)
    steps = np.linalg.norm(np.diff(world.T_flat[:, :2, 3], axis=0), axis=1)
    stands = np.flatnonzero(steps < 0.01)
    assert len(stands) >= 8

    def vehicles(i):
        """Bodies around us in the world, by looks: vehicles have no names."""
        bodies = np.split(world.moving(i), 2)[0]
        T = world.T_flat[i]
        near = np.hypot(bodies[:, 0] - T[0, 3], bodies[:, 1] - T[1, 3]) < 30
        return {tuple(b[kitti.HALF_X:]): b[:2] for b in bodies[near]}

    i = stands[len(stands) // 2]
    before, now, after = vehicles(i - 1), vehicles(i), vehicles(i + 60)
    moved = {look: np.linalg.norm(now[look] - before[look]) for look in now.keys() & before.keys()}
    standing = [look for look, step in moved.items() if step < 0.01]
    assert len(standing) >= 2
    assert any(look in after and np.linalg.norm(after[look] - now[look]) > 5 for look in standing)


@pytest.mark.skipif(not KITTI.is_dir(), reason="D3DLO_KITTI names no folder")
def test_real_scans_are_sampled_as_by_fps_textbook_and_lose_their_ground():
    for s in kitti.open_sequences(KITTI):
        scan = s.scan(len(s) // 2)
        xyz = scan[:, :3]
        assert_array_equal(farthest_point_sampling(xyz, 128), fps_textbook(xyz, 128))
        assert 0.25 < 1 - len(kitti.remove_plane(scan)) / len(scan) < 0.65


def write_root(root, names=("00",), scans=6, size=1100, step=1.0):
    """Random scans in KITTI's layout, for tests where it does not matter what is learned."""
    rng, Tr = generator(0), euler_pose(np.array([0.1, -0.2, 0.3, -90, 0, -90]))
    for name in names:
        folder = root / "sequences" / name
        (folder / "velodyne").mkdir(parents=True)
        for i in range(scans):
            random_scan(rng, size).tofile(folder / "velodyne" / f"{i:06d}.bin")
        numbers = " ".join(map(repr, Tr[:3].ravel().tolist()))
        (folder / "calib.txt").write_text(f"P0: 1 0 0 0 0 1 0 0 0 0 1 0\nTr: {numbers}\n")
        poses = random_trajectory(rng, scans, (step, 0.1, 0.1, 0.3, 0.3, 1))
        metrics.write_poses(root / "poses" / f"{name}.txt", poses)
    return root


def write_folder(folder, scans=12, size=50, save=np.save, name="scan {}.npy", scale=1, columns=4):
    """Write a plain folder of random scans, numbered from 1. Returns the scans."""
    rng = generator(0)
    folder.mkdir()
    factors = np.float32([1, 1, 1, scale])
    made = [(random_scan(rng, size) * factors)[:, :columns] for _ in range(scans)]
    for i, scan in enumerate(made, 1):
        save(folder / name.format(i), scan)
    return made


def save_bin(path, scan):
    scan.tofile(path)


@table("save, name", {"bin": (save_bin, "{}.pcd.bin"), "npy": (np.save, "scan-{}-of-12.npy")})
def test_a_folder_of_scans_is_one_sequence_in_natural_order(tmp_path, save, name):
    scans = write_folder(tmp_path / "drive", save=save, name=name)
    (tmp_path / "drive" / "._1.bin").write_text("left by another system")
    (tmp_path / "drive" / "notes.txt").write_text("not a scan")
    s, = kitti.open_sequences(tmp_path / "drive")
    assert kitti.sequence_names(tmp_path / "drive") == [s.name] == ["drive"] and len(s) == 12
    for i, scan in enumerate(scans):  # 2 comes before 10
        assert s.scan(i).dtype == np.float32
        assert_array_equal(s.scan(i), scan)
    assert s.Tr is None and s.poses is None and s.poses_cam is None
    with pytest.raises(ValueError, match="drive has no ground truth"):
        s.motions()
    with pytest.raises(ValueError, match="'00'.*drive"):
        kitti.open_sequences(tmp_path / "drive", ["00"])


def test_times_of_a_folder_come_from_times_txt_or_assume_ten_scans_a_second(tmp_path):
    write_folder(tmp_path / "drive")
    s, = kitti.open_sequences(tmp_path / "drive")
    assert_allclose(s.times, np.arange(12) / 10)
    assert "10 scans a second" in " ".join(s.notes)
    times = 1.3e9 + np.arange(12) * 0.25
    np.savetxt(tmp_path / "drive" / "times.txt", times, fmt="%.6f")
    s, = kitti.open_sequences(tmp_path / "drive")
    assert_allclose(s.times, times, rtol=0, atol=1e-6)
    assert s.notes == []


@pytest.mark.parametrize("name, removed, note", [
    ("{:06d}.npy", (4, 5, 9), "3 scans are missing, the first after 000003.npy"),
    ("{}00000.npy", (4, 5, 9), ""), ("scan {}.npy", (4, 5, 9), ""),  # times and other names
    ("{:06d}.npy", (1, 2, 12), ""), ("{:06d}.npy", range(2, 12, 2), "")])  # cut, every second scan
def test_missing_scans_of_a_numbered_folder_are_noted(tmp_path, name, removed, note):
    write_folder(tmp_path / "drive", name=name)
    for i in removed:
        (tmp_path / "drive" / name.format(i)).unlink()
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


def test_the_intensity_scale_of_a_folder_depends_on_ten_scans_spread_over_it(tmp_path):
    scans = write_folder(tmp_path / "drive", scans=37)
    looked_at = set(range(0, 37, 4))  # 10 of 37, the first and the last among them
    for bright in range(37):
        path = tmp_path / "drive" / f"scan {bright + 1}.npy"
        np.save(path, scans[bright] * np.float32([1, 1, 1, 200]))
        s, = kitti.open_sequences(tmp_path / "drive")
        assert s.intensity_max == (255 if bright in looked_at else 1)
        assert_array_equal(s.scan(5)[:, 3], np.load(s.scan_paths[5])[:, 3] / s.intensity_max)
        np.save(path, scans[bright])


def test_a_truncated_scan_is_named_before_any_work_begins(tmp_path):
    write_folder(tmp_path / "drive", scans=37, save=save_bin, name="{}.bin")
    for i in range(1, 38):  # also the scans that are not read
        whole = (tmp_path / "drive" / f"{i}.bin").read_bytes()
        (tmp_path / "drive" / f"{i}.bin").write_bytes(whole[:-1])
        with pytest.raises(ValueError, match=f"/{i}.bin has 799 bytes"):
            kitti.open_sequences(tmp_path / "drive")
        (tmp_path / "drive" / f"{i}.bin").write_bytes(whole)


# Functions that spoil good data. Each returns a function of the folder that holds the data.


def save_as(name, array):
    return lambda folder: np.save(folder / name, array, allow_pickle=True)


def write_as(name, text):
    return lambda folder: (folder / name).write_text(text)


def five_floats(points):
    """Replace scans by nuScenes' format: x, y, z, intensity up to 255, number of the beam."""
    def spoil(folder):
        for path in list(folder.iterdir()):
            scan = random_scan(generator(1), points) * np.float32([1, 1, 1, 255])
            np.c_[scan, np.arange(points) % 32].astype(np.float32).tofile(path.with_suffix(".bin"))
            path.unlink()

    return spoil


class Mischief:
    """Makes a folder when it is unpickled, as a malicious file might run code."""

    def __reduce__(self):
        return os.mkdir, ("mischief",)


@table("spoil, words", {  # what to do to a good folder of scans, and what the message must contain
    "nuScenes": (five_floats(52), ("1.bin", "reshape(-1, 5)[:, :4]", "nuScenes")),
    "nuScenes, of an odd size": (five_floats(51), ("1.bin", "reshape(-1, 5)[:, :4]", "nuScenes")),
    "16 bits": (save_as("scan 1.npy", np.full((9, 4), 300)), ("scan 1.npy", "300", "rescale")),
    "negative": (save_as("scan 12.npy", np.full((9, 4), -0.5)), ("scan 12.npy", "-0.5")),
    "two kinds": (lambda folder: (folder / "0.bin").write_bytes(b"0" * 16), ("drive", ".npy")),
    "five columns": (save_as("scan 1.npy", np.ones((9, 5))), ("scan 1.npy", "(9, 5)")),
    "no points": (save_as("scan 1.npy", np.ones((0, 4))), ("scan 1.npy", "(0, 4)")),
    "words": (save_as("scan 1.npy", np.full((9, 4), "x")), ("scan 1.npy", "numbers")),
    "an archive": (lambda folder: np.savez(open(folder / "scan 1.npy", "wb"), np.ones((9, 4))),
                   ("scan 1.npy", "(N,4)")),
    "a damaged file": (write_as("scan 1.npy", "damaged"), ("scan 1.npy", "damaged")),
    "an empty file": (write_as("scan 1.npy", ""), ("scan 1.npy", "damaged")),
    "code": (save_as("scan 1.npy", np.array([Mischief()])), ("scan 1.npy", "damaged")),
    "a time too few": (write_as("times.txt", "1 2 3"), ("times.txt", "12")),
    "times that go back": (write_as("times.txt", "1 2 3 4 5 6 7 8 9 10 11 0"), ("increasing",)),
    "times that are dates": (write_as("times.txt", "2011-09-26 " * 12), ("times.txt", "seconds")),
})
def test_an_invalid_folder_of_scans_is_refused_in_one_line(cwd, spoil, words):
    write_folder(cwd / "drive")
    spoil(cwd / "drive")
    before = files_of(cwd)
    with pytest.raises(ValueError) as refused:
        kitti.open_sequences(cwd / "drive")
    message = str(refused.value)
    assert all(word in message for word in words) and "\n" not in message, message
    assert files_of(cwd) == before and not (cwd / "mischief").exists()


def test_the_cache_equals_scan_geometry_and_is_rebuilt_when_scans_or_settings_change(tmp_path):
    root = write_root(tmp_path / "root", ("00", "drive"), size=60)
    cache = tmp_path / "cache"

    def load(config=SMALL):
        sequences = kitti.open_sequences(root)
        geometry, fingerprints = load_geometry(sequences, config, cache)
        assert len(set(fingerprints)) == 2
        for s, records in zip(sequences, geometry, strict=True):
            expected = [scan_geometry(s.scan(i), config).tobytes() for i in range(len(s))]
            assert [record.tobytes() for record in records] == expected
        return {path: path.stat().st_mtime_ns for path in cache.iterdir()}

    first = load()
    assert len(first) == 2 and load() == first  # the second time nothing is computed

    # Change a scan, neither the first nor the last one, and keep its size
    path = root / "sequences" / "drive" / "velodyne" / "000002.bin"
    stamp = path.stat().st_mtime_ns + 10**9
    random_scan(generator(5), 60).tofile(path)
    os.utime(path, ns=(stamp, stamp))
    assert len(load()) == 3  # only the sequence that changed

    changes = [dict(sa1=Layer(1.0, *SMALL.sa1[1:])),
               dict(sa1=Layer(2.0, 32, 5, (4, 8, 16))),
               dict(sa2=Layer(4.0, 12, 8, (32, 32))),
               dict(sa2=Layer(3.0, *SMALL.sa2[1:])),
               dict(sa3=Layer(7.0, *SMALL.sa3[1:])),
               dict(plane=False),
               dict(max_range=9.0)]
    for i, change in enumerate(changes):
        assert len(load(replace(SMALL, **change))) == 5 + 2 * i
    unrelated = replace(SMALL, fe=Layer(None, None, 3, (16, 32)), lr=5.0, swap="random")
    assert len(load(unrelated)) == 5 + 2 * i


def test_a_damaged_cache_is_computed_again(tmp_path):
    sequences = kitti.open_sequences(write_root(tmp_path / "root", size=60))
    cache = tmp_path / "cache"
    load_geometry(sequences, SMALL, cache)
    file, = cache.iterdir()
    good = file.read_bytes()
    for i in (0, 9, len(good) - 1, *generator(0).integers(len(good), size=7)):
        cut_short = good[:i]
        one_bit_flipped = good[:i] + bytes([good[i] ^ 16]) + good[i + 1:]
        for bad in (cut_short, one_bit_flipped):
            file.write_bytes(bad)
            load_geometry(sequences, SMALL, cache)
            assert file.read_bytes() == good and [*cache.iterdir()] == [file]


def test_temporary_files_of_dead_processes_are_deleted_and_those_of_living_ones_kept(tmp_path):
    print_pid = [sys.executable, "-c", "import os; print(os.getpid())"]
    dead = subprocess.run(print_pid, capture_output=True, text=True).stdout.strip()
    mine = metrics.temporary_beside(tmp_path / "a.npy")
    left = {pid: mine.with_name(mine.name.replace(str(os.getpid()), pid))
            for pid in (dead, "1", "no-pid")}
    other = mine.with_name(f".b.npy.{dead}")  # beside another file
    for path in (*left.values(), other):
        path.write_text("")
    assert metrics.temporary_beside(tmp_path / "a.npy") == mine
    assert sorted(tmp_path.iterdir()) == sorted([left["1"], left["no-pid"], other])


def test_a_scan_changed_with_the_same_size_and_time_is_computed_again(tmp_path):
    sequences = kitti.open_sequences(write_root(tmp_path / "root", size=60))

    def load():
        (records,), (fingerprint,) = load_geometry(sequences, SMALL, tmp_path / "cache")
        return [record.tobytes() for record in records], fingerprint

    (old, before), path = load(), sequences[0].scan_paths[3]
    change_in_the_middle(path)
    new, after = load()
    assert before != after
    assert [i for i in range(6) if old[i] != new[i]] == [3]
    assert new[3] == scan_geometry(sequences[0].scan(3), SMALL).tobytes()


def change_in_the_middle(path):
    """Change a scan file but keep its size and modification time, as `rsync -t` may do."""
    data, stat = bytearray(path.read_bytes()), path.stat()
    data[len(data) // 32 * 16 + 3] ^= 128  # flips the sign of an x
    path.write_bytes(data)
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    assert path.stat().st_mtime_ns == stat.st_mtime_ns


def test_only_regular_files_are_replaced(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    for name in ("pipe", "folder"):
        with pytest.raises(OSError, match=f"{name}.*not a regular file"):
            metrics.write_poses(tmp_path / name, straight_path(2))
    assert (tmp_path / "pipe").is_fifo() and sorted(os.listdir(tmp_path)) == ["folder", "pipe"]


def test_an_error_for_a_full_disk_names_the_file(tmp_path):
    with pytest.raises(OSError, match=f"No space.*{tmp_path / 'a.txt'}"):
        with metrics.replacing(tmp_path / "a.txt"):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert not any(tmp_path.iterdir())


def test_default_folder_names_made_in_the_same_second_differ(tmp_path, monkeypatch):
    monkeypatch.setattr(time, "strftime", lambda form: "now")
    names = []
    for _ in range(3):
        names.append(kitti.unused_path(tmp_path / "runs"))
        names[-1].mkdir(parents=True)
    assert len(set(names)) == 3 and {path.parent for path in names} == {tmp_path / "runs"}


def test_a_pose_file_may_begin_with_a_byte_order_mark_but_utf_16_is_refused(tmp_path):
    path, T = tmp_path / "a.txt", straight_path(3)
    metrics.write_poses(path, T)
    text = path.read_text()
    path.write_text(text, encoding="utf-8-sig")  # with a byte order mark
    assert_allclose(metrics.read_poses(path), T)
    path.write_text(text, encoding="utf-16")
    with pytest.raises(ValueError, match="a.txt.*UTF-16"):
        metrics.read_poses(path)


HOLDER = """
import sys, time
from pathlib import Path
import kitti
with kitti.run_folder(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


def test_a_run_folder_is_locked_by_one_process_and_free_once_it_is_killed(tmp_path):
    command = [sys.executable, "-c", HOLDER, tmp_path / "run"]
    other = subprocess.Popen(command, stdout=subprocess.PIPE, cwd=HERE, text=True)
    try:
        assert other.stdout.readline() == "held\n"
        with pytest.raises(ValueError, match=rf"run: .*process {other.pid} on ."):
            with kitti.run_folder(tmp_path / "run"):
                pass
    finally:
        other.kill()
        other.communicate()
    with kitti.run_folder(tmp_path / "run"):  # free again; the lock names its holder
        assert (tmp_path / "run" / "lock").read_text().startswith(f"process {os.getpid()} on ")


UNGUARDED = """
import multiprocessing, kitti
multiprocessing.set_start_method("spawn", force=True)
try:
    print([*kitti.in_processes(abs, [1, 2], workers=1)])
except OSError as error:
    print(error)
"""


def test_a_script_without_a_main_guard_gets_an_error_that_explains_it(tmp_path):
    (tmp_path / "script.py").write_text(UNGUARDED)
    environment = os.environ | {"PYTHONPATH": str(HERE)}
    ran = subprocess.run([sys.executable, tmp_path / "script.py"], env=environment, timeout=60,
                         capture_output=True, text=True)
    line, = ran.stdout.splitlines()
    assert "if __name__ == '__main__':" in line and ran.returncode == 0


# ------------------------------------------------------------------------------------------------
# Weights and odometry


def save_weights(path, config=Config(), **facts):
    """Write a weights file as `fit` does, of an untrained network. Returns the network."""
    net = random_net(generator(0), config)
    d3dlo.save(path, config=config.as_dict(), model=net.state_dict(), step=0, **FACTS | facts)
    return net


@table("config", {
    "small": replace(SMALL, batch=3, swap="random", sa1=Layer(1.5, 40, 5, (6, 10))),
    "default": Config()})
def test_a_weights_file_is_enough_to_rebuild_its_network(tmp_path, config):
    net, rng = save_weights(tmp_path / "weights.pt", config), generator(0)
    p, q = random_scan(rng, 1100), random_scan(rng, 1100)
    for path in (tmp_path / "weights.pt", tmp_path):  # a file, or the folder of its run
        loaded, _ = load_weights(path)
        assert loaded.config == config and not loaded.training
        assert_array_equal(predict(loaded, p, q), predict(net, p, q))


@pytest.fixture(scope="session")
def new_drive(tmp_path_factory):
    """A simulated sequence that the pretrained weights have not seen, and its geometry."""
    root = tmp_path_factory.mktemp("new")
    s, = kitti.open_sequences(kitti.simulate(root, seed=1, sequences=["06"], scans=8, workers=1))
    config = load_weights()[0].config
    return s, np.stack([scan_geometry(s.scan(i), config) for i in range(8)])


def test_the_pretrained_weights_are_accurate_on_an_unseen_sequence(new_drive):
    s, _ = new_drive
    moved = np.linalg.norm(s.motions()[:, :3, 3], axis=1)
    for refine in (0, 2):
        odometry = d3dlo.Odometry(refine=refine)
        poses = np.stack([odometry.register(s.scan(i)) for i in range(len(s))])
        t, r = metrics.step_errors(s.poses, poses).mean(0)
        assert count(odometry.net) == 61290 and moved.mean() > 0.5 and t < 0.15 and r < 0.2


@torch.inference_mode()
def test_in_bfloat16_the_pretrained_weights_predict_nearly_the_same(new_drive):
    (_, records), (net, _) = new_drive, load_weights()
    p, q = np.r_[:7, 1:8], np.r_[1:8, :7]  # both directions
    batch = d3dlo.make_batch(records, p, q, net.config)
    expected = net(batch)
    with torch.autocast("cpu", torch.bfloat16):
        got = net(batch)
    assert got.dtype == torch.bfloat16
    assert (got.float() - expected).norm() < 0.02 * (expected - expected.mean(0)).norm()


@given(SEED)
def test_odometry_multiplies_relative_poses_and_a_refused_scan_changes_nothing(tmp_path, seed):
    rng, path = generator(seed), tmp_path / "w.pt"
    net, scans = save_weights(path, SMALL), [random_scan(rng, 60) for _ in range(5)]
    odometry, expected = d3dlo.Odometry(path), np.eye(4)
    for i, scan in enumerate(scans):
        huge_intensity = scan * np.float32([1, 1, 1, 3e38])
        for bad in (scan[:, :3], scan[0], scan[:10], scan * np.nan, scan + 99, huge_intensity):
            with pytest.raises(ValueError):
                odometry.register(bad)
        if i:
            expected = expected @ d3dlo.relative_pose(scans[i - 1], scan, path)
        pose = odometry.register(scan)
        assert pose.shape == (4, 4) and pose.dtype == float
        assert_allclose(pose, expected, atol=1e-9)
        pose[:] = 0  # it is a copy, so the next pose is not affected
    # Predicting several pairs in one batch gives the same poses
    records = np.stack([scan_geometry(scan, SMALL) for scan in scans])
    together = d3dlo.predict_motions(net, records, batch=3)
    assert_allclose(d3dlo.accumulate(together)[-1], expected, atol=1e-3)


@given(SEED, st.integers(1, 5), st.integers(48, 200))
def test_samplings_share_no_centroid_and_are_grouped_in_the_whole_scan(seed, n, points):
    scan = random_scan(generator(seed), points)
    records = d3dlo.several_samplings(scan, SMALL, n)
    parts = min(n, points // SMALL.sa1.n_fps)  # fewer parts where there are too few points
    tree = cKDTree(scan[:, :3])
    for k, record in enumerate(records):
        part = np.arange(points // parts * parts)[k % parts::parts]
        centroids = part[fps_textbook(scan[part, :3], SMALL.sa1.n_fps)]
        assert_array_equal(record, d3dlo.group_scan(scan, 0, centroids, tree, SMALL))
    assert len(records) == n
    assert n > 1 or records.tobytes() == scan_geometry(scan, SMALL).tobytes()


@given(SEED, st.integers(1, 4))
def test_refining_averages_directions_samplings_and_references(seed, n):
    def one_way(p, q):
        """Replace the network by a small, smooth motion that differs in the two directions."""
        return from_vector((p["xyz"][:2] - 0.7 * q["xyz"][1:3]).ravel() / 10)

    def predict_one_way(net, scans, p, q, device):
        return np.stack([one_way(*scans[[i, j]]) for i, j in zip(p, q)])

    def mean(motions):
        T = np.mean(motions, 0)
        T[:3, :3] = Rotation.from_matrix([T[:3, :3] for T in motions]).mean().as_matrix()
        return T

    rng = generator(seed)
    *earlier, q = (d3dlo.several_samplings(random_scan(rng, 48), SMALL, n) for _ in range(n + 1))
    poses, pose = random_motion(rng, n=n), random_motion(rng)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(d3dlo, "predict", predict_one_way)
        got = d3dlo.refine_pose(None, list(zip(earlier, poses)), q, pose, "cpu")
    estimates = []
    for k in range(n):
        p_k, T_0p = earlier[k][k], poses[k]
        T = np.linalg.inv(T_0p) @ pose
        aligned, = d3dlo.move_scans(q[k][None], T[None])  # tested with the augmentation
        pose = T_0p @ mean([one_way(p_k, aligned), invert(one_way(aligned, p_k))]) @ T
        estimates.append(pose)
    assert_allclose(got, mean(estimates), atol=2e-3)


@given(SEED)
def test_refined_odometry_registers_against_keyframes(tmp_path, seed):
    """With plain predictions off by some decimetres and exact refined ones, all poses are exact."""
    rng = generator(seed)
    motions = random_motion(rng, n=20) @ from_vector([1.0, 0, 0, 0, 0, 4])
    truth, calls = d3dlo.accumulate(motions), []

    def number(records):
        return int(np.ravel(records["broken"])[0])

    def plain(net, pair, device):
        p, q = (number(record) for record in pair)
        assert q == p + 1
        return [motions[p] @ from_vector([0.3, 0.1, 0, 0, 0, 1])]

    def refined(net, references, samplings, pose, device):
        q = number(samplings)
        calls.append((*(number(records) for records, _ in references), q, len(samplings)))
        for records, T_0p in references:
            assert_allclose(T_0p, truth[number(records)], atol=1e-6)
        assert_allclose(invert(truth[q]) @ pose, from_vector([0.3, 0.1, 0, 0, 0, 1]), atol=1e-6)
        return truth[q]

    save_weights(tmp_path / "w.pt", SMALL)
    odometry = d3dlo.Odometry(tmp_path / "w.pt", refine=3)
    expected, keyframe = [], 0
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(d3dlo, "predict_motions", plain)
        patch.setattr(d3dlo, "refine_pose", refined)
        for i in range(21):
            records = np.zeros(3, d3dlo.geometry_dtype(SMALL))
            records["broken"] = i
            assert_allclose(odometry.register_records(records), truth[i], atol=1e-6)
            if i:
                expected.append((keyframe, i - 1, i - 1, i, 3))
                T = invert(truth[keyframe]) @ truth[i]
                angle = np.degrees(np.arccos(np.clip((np.trace(T[:3, :3]) - 1) / 2, -1, 1)))
                if np.linalg.norm(T[:3, 3]) >= 5 or angle >= 20:
                    keyframe = i
    assert calls == expected and keyframe > 0


def test_refined_poses_stay_rigid_in_a_long_drive(tmp_path):
    """Inverting by transposition must not let rounding errors grow from scan to scan."""
    rng = generator(0)
    save_weights(tmp_path / "w.pt", SMALL)
    odometry = d3dlo.Odometry(tmp_path / "w.pt", refine=1)
    records = np.zeros(1, d3dlo.geometry_dtype(SMALL))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(d3dlo, "predict", lambda net, scans, p, *_: random_motion(rng, n=len(p)))
        for _ in range(300):
            pose = odometry.register_records(records)
    assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-9)


@pytest.mark.parametrize("refine", [-1, 1.5, "1", None, float("nan"), True])
def test_an_invalid_number_of_refinements_is_refused(weights, refine):
    assert d3dlo.Odometry(weights, refine=np.int64(2)).refine == 2
    scan = np.ones((2000, 4), np.float32)
    for call in (lambda: d3dlo.Odometry(weights, refine=refine),
                 lambda: d3dlo.relative_pose(scan, scan, weights, refine),
                 lambda: d3dlo.evaluate(weights=weights, refine=refine)):
        with pytest.raises(ValueError, match="refine"):
            call()


NAN = float("nan")
INVALID_SETTINGS = [
    (dict(epochs=1.5), "epochs"),
    (dict(epochs=0), "epochs"),
    (dict(batch=NAN), "batch"),
    (dict(sa1=Config.sa1._replace(r=-1.0)), "radius"),
    (dict(sa2=Config.sa2._replace(r=NAN)), "radius"),
    (dict(sa3=Config.sa3._replace(r=0)), "radius"),
    (dict(max_range=-50.0), "max_range"),
    (dict(max_range=NAN), "max_range"),
    (dict(max_range=0), "max_range"),
    (dict(lr=NAN), "lr"),
    (dict(lr=-1e-3), "lr"),
    (dict(lr=float("inf")), "lr"),
    (dict(frozen=1.0), "frozen"),
    (dict(frozen=-0.1), "frozen"),
    (dict(frozen=NAN), "frozen"),
    (dict(sa1=Config.sa1._replace(n_n=99999999)), "n_n"),
    (dict(fe=Config.fe._replace(n_n=0)), "n_n"),
    (dict(sa1=Config.sa1._replace(n_fps=65536)), "n_fps"),
    (dict(sa3=Config.sa3._replace(n_fps=257)), "n_fps"),
    (dict(plane="no"), "plane"),
    (dict(augment=2), "augment"),
    (dict(optimizer="sgd"), "optimizer"),
    (dict(schedule="cosine"), "schedule"),
    (dict(swap="always"), "swap"),
    (dict(mlp=Layer(None, None, None, (64, 7))), "mlp"),
    (dict(mpn=Layer(None, None, None, ())), "MLP"),
]


@table("invalid, name", {str(invalid): (invalid, name) for invalid, name in INVALID_SETTINGS})
def test_an_invalid_config_is_refused_with_the_name_of_the_setting(invalid, name):
    with pytest.raises(ValueError, match=rf"Config: .*{name}"):
        Config(**invalid)


def empty_field(rng):
    xy = rng.uniform(-50, 50, (5000, 2))
    return np.c_[xy, np.full(5000, -1.73), np.full(5000, 0.3)]


def corridor(rng):
    x, y, z = rng.uniform(-80, 80, 5000), rng.choice([-2, 2], 5000), rng.uniform(-1, 2, 5000)
    return np.c_[x, y, z, np.full(5000, 0.3)]


@pytest.mark.filterwarnings("ignore")
@table("scene", {
    "an empty field": empty_field,
    "a corridor": corridor,
    "exactly 1,024 points": lambda rng: random_scan(rng, 1024),
    "all points at one place": lambda rng: np.ones((2000, 4)),
    "all points at the sensor": lambda rng: np.zeros((2000, 4)),
    "1,000,000 points": lambda rng: random_scan(rng, 1_000_000),
})
def test_degenerate_scenes_give_a_rigid_motion(tmp_path, scene):
    save_weights(tmp_path / "w.pt")
    p = scene(generator(0)).astype(np.float32)
    turned_round = transform_scan(from_vector([0, 0, 0, 0, 0, 180]), p)
    for q in (p, turned_round):
        for refine in (0, 1):
            T = d3dlo.relative_pose(p, q, tmp_path / "w.pt", refine)
            assert_allclose(T @ invert(T), np.eye(4), atol=1e-9)  # fails for NaN, too


# Also values close to the bounds, which are rarely drawn from an interval
FACTORS = st.floats(0.1, 10) | st.sampled_from([0.66, 0.67, 1.49, 1.51])
SPREADS = st.floats(1, 5) | st.just(1.0)


@given(st.lists(FACTORS, min_size=4, max_size=4), st.lists(SPREADS, min_size=4, max_size=4))
def test_domain_shift_names_each_statistic_out_of_range(factors, spread):
    low = np.arange(1.0, 5)
    high = low * spread
    stats = low * factors
    shift = kitti.domain_shift(stats, [low, high])
    for name, x, a, b in zip(kitti.STATS, stats, low, high):
        assert (name in shift) == (x < a / 1.5 or x > b * 1.5)


def test_odometry_and_eval_warn_once_about_domain_shift_and_invalid_points(cwd, capsys):
    save_weights(cwd / "w.pt", seen=[[1e5, 0.1, 1, 0.01], [2e5, 1, 100, 1]])
    odometry = d3dlo.Odometry(cwd / "w.pt")
    scans = [random_scan(generator(i), 1100) for i in range(3)]
    with pytest.warns(UserWarning) as warned:
        for scan in (*scans, np.insert(scans[0], 7, np.nan, axis=0)):
            odometry.register(scan)
    shift, broken = (str(warning.message) for warning in warned)
    assert "usable points 1.1e+03 (in training 1e+05" in shift and "dropped 1 " in broken
    rewrite(SCAN, lambda b: b"\xff" * 16 + b)(write_root(cwd / "root"))
    assert d3dlo.main(["eval", "--data", "root", "--weights", "w.pt", "--out", "out"]) == 0
    broken, shift = error_lines(capsys.readouterr().err)
    assert "sequence 00" in shift and "usable points" in shift and "dropped 1 " in broken


# ------------------------------------------------------------------------------------------------
# The command line


@pytest.fixture
def cwd(tmp_path, monkeypatch):
    """An empty current folder, for runs, results and caches."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="session")
def weights(tmp_path_factory):
    save_weights(path := tmp_path_factory.mktemp("weights") / "weights.pt")
    return path


def error_lines(err):
    """The lines of stderr that do not show progress."""
    lines = [line for line in err.splitlines() if line.strip()]
    return [line for line in lines if not re.search(r": \d+/\d+, .* left$", line.strip())]


def fails_with_one_line(main, arguments, words, capsys):
    """Assert that a command fails with one line on stderr that contains `words`. Returns it."""
    code = main([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    lines = error_lines(err)
    assert code == 2 and len(lines) == 1 and words in lines[0] and "Traceback" not in err + out, err
    return lines[0]


def table_row(out, name):
    """A row of a printed table: [segments, E_t, E_r, t step, r step, ...].

    The star that marks sequences trained on is left out.
    """
    return re.search(rf"^{name}(?: \*)? +(\S.*)$", out, re.M)[1].split()


def as_printed(s):
    """The numbers of a sequence or group in results.json, as a row of the printed table."""
    formats = {"segments": "d", "E_t": ".3f", "E_r": ".5f", "t_step_m": ".4f", "r_step_deg": ".4f"}
    return ["-" if s[key] is None else format(s[key], f) for key, f in formats.items()]


def results_of(folder):
    """The content of results.json."""
    return json.loads((Path(folder) / "results.json").read_text())


def test_eval_writes_what_it_prints_agrees_with_metrics_and_zips_server_sequences(
        cwd, weights, capsys):
    # KITTI's sequences 11 to 21 have no ground truth, but their trajectories are written too
    server = [f"{i}" for i in range(11, 22)]
    shutil.rmtree(write_root(cwd / "root", server, scans=2) / "poses")
    # Steps of about 11 m, so that there are segments of 100 m
    root = write_root(cwd / "root", ("03", "07"), scans=15, step=14)
    (root / "sequences" / "05").mkdir()  # a sequence may have no scans: it is skipped
    arguments = ["eval", "--data", "root", "--weights", str(weights), "--out", "out"]
    assert d3dlo.main(arguments) == 0

    # The printed numbers are those in results.json
    out, err = capsys.readouterr()
    results, (net, _) = results_of("out"), load_weights(weights)
    sequences, pooled, names = results["sequences"], results["pooled"], ["03", "07", *server]
    trajectories = [f"{name}.txt" for name in names]
    assert error_lines(err) == []
    assert sorted(os.listdir("out")) == [*trajectories, "kitti-server.zip", "results.json"]
    assert list(sequences) == names and set(results["splits"]) == {"test", "validation"}
    for name, s in [*sequences.items(), ("all", pooled)]:
        assert table_row(out, name) == as_printed(s) and s["trained_on"] is False
    assert sequences["11"]["E_t"] is None

    # Compute them again from the trajectories, and these from the scans
    segments = []
    for s in kitti.open_sequences(root, ["03", "07"]):
        T, got = metrics.read_poses(cwd / "out" / f"{s.name}.txt"), sequences[s.name]
        T_velo = kitti.camera_to_velo(T, s.Tr)
        segments.append(devkit_errors(s.poses_cam, T)[:, 3:])
        expected = [*segments[-1].mean(0), *metrics.step_errors(s.poses, T_velo).mean(0)]
        got = [got[key] for key in ("E_t", "E_r", "t_step_m", "r_step_deg")]
        assert_allclose(got, expected, rtol=1e-5)
        motions = [from_vector(predict(net, s.scan(i), s.scan(i + 1))) for i in range(14)]
        assert_allclose(T_velo, d3dlo.accumulate(motions), rtol=1e-3, atol=1e-3)
    got = [pooled[key] for key in ("E_t", "E_r")]
    assert_allclose(got, np.concatenate(segments).mean(0), rtol=1e-5)

    # metrics.py works in the camera frame: the same segment errors, other step errors
    assert metrics.main(["root/poses", "out"]) == 0
    out = capsys.readouterr().out
    for name in ("03", "07"):
        assert table_row(out, name)[:3] == as_printed(sequences[name])[:3]

    # The archive for KITTI's server holds trajectories at its top level
    with zipfile.ZipFile("out/kitti-server.zip") as archive:
        assert archive.namelist() == [f"{name}.txt" for name in server]
        for name in archive.namelist():
            assert archive.read(name) == Path("out", name).read_bytes()
            assert np.loadtxt(archive.open(name)).shape == (2, 12)


@pytest.mark.parametrize("save, name, scale", [(save_bin, "{}.bin", 1), (np.save, "{}.npy", 255)])
def test_eval_takes_a_plain_folder_of_scans(cwd, weights, capsys, save, name, scale):
    scans = write_folder(cwd / "drive", size=1100, save=save, name=name, scale=scale)
    arguments = ["eval", "--data", "drive", "--weights", str(weights), "--out"]
    assert d3dlo.main([*arguments, "out"]) == 0
    (out, err), (net, _) = capsys.readouterr(), load_weights(weights)
    assert sorted(os.listdir("out")) == ["poses.tum", "poses.txt", "results.json"]
    scans = [scan / np.float32([1, 1, 1, scale]) for scan in scans]
    motions = [from_vector(predict(net, p, q)) for p, q in zip(scans, scans[1:])]
    poses, rows = metrics.read_poses("out/poses.txt"), np.loadtxt("out/poses.tum")
    assert_allclose(poses, d3dlo.accumulate(motions), rtol=1e-3, atol=1e-3)
    assert_allclose(rows[:, 0], np.arange(12) / 10)
    assert_allclose(rows[:, 1:4], poses[:, :3, 3], atol=1e-6)
    assert_allclose(Rotation.from_quat(rows[:, 4:]).as_matrix(), poses[:, :3, :3], atol=1e-6)

    metres = float(re.search(r"^drive: 12 scans, path of (\S+) m$", out, re.M)[1])
    assert metres == pytest.approx(metrics.path_lengths(poses)[-1], abs=0.06)
    assert error_lines(err) == []
    assert "LiDAR at the first scan" in out and "out/poses.txt" in out and "out/poses.tum" in out
    assert "10 scans a second" in out and ("divided by 255" in out) == (scale > 1)

    (cwd / "drive" / "times.txt").write_text("\n".join(f"{7 + i}" for i in range(12)))
    assert d3dlo.main([*arguments, "again"]) == 0
    expected = np.c_[7 + np.arange(12), rows[:, 1:]]
    assert_allclose(np.loadtxt("again/poses.tum"), expected, atol=1e-8)
    assert "10 scans" not in capsys.readouterr().out


def test_eval_draws_a_plain_folder_if_matplotlib_is_installed(cwd, weights, capsys):
    pytest.importorskip("matplotlib")
    write_folder(cwd / "drive", scans=3, size=1100)
    arguments = ["eval", "--data", "drive", "--weights", str(weights), "--out", "out", "--plot"]
    assert d3dlo.main(arguments) == 0 and "out/plot.png" in capsys.readouterr().out
    assert (cwd / "out" / "plot.png").read_bytes().startswith(b"\x89PNG")


def test_an_unusable_plain_folder_fails_with_one_line(cwd, weights, capsys):
    write_folder(cwd / "drive", size=1100)
    train = ["train", "--data", "drive", "--out", "run"]
    evaluate = ["eval", "--data", "drive", "--weights", weights, "--out", "out"]
    fails_with_one_line(d3dlo.main, train, "drive has no ground truth", capsys)
    np.save(cwd / "drive" / "scan 2.npy", random_scan(generator(0), 900))
    fails_with_one_line(d3dlo.main, evaluate, "scan 2.npy: 900 usable", capsys)
    five_floats(52)(cwd / "drive")
    fails_with_one_line(d3dlo.main, evaluate, "nuScenes", capsys)
    assert all(name.startswith("drive/") for name in files_of(cwd))  # no new files


def test_train_stores_a_run_that_eval_reads_and_nothing_overwrites(cwd, city, capsys):
    arguments = ["train", "--data", shutil.copytree(city, "data"), "--epochs", "1", "--out", "run"]
    assert d3dlo.main(arguments) == 0
    out, err = capsys.readouterr()
    assert error_lines(err) == [] and "61,290 parameters" in out and not list(cwd.rglob(".*"))
    run = cwd / "run"
    assert set(os.listdir(run)) == {
        "weights.pt", "checkpoint.pt", "config.json", "lock", "log.txt", "results"}
    trained = results_of(run / "results")
    before = (run / "checkpoint.pt").read_bytes()
    assert table_row(out, "07") == as_printed(trained["sequences"]["07"])
    assert (run / "log.txt").read_text() == out
    assert d3dlo.main(["eval", "--data", "data", "--weights", "run", "--out", "out"]) == 0
    results, out = results_of("out"), capsys.readouterr().out
    # 07 is held out, so the training run evaluated it at the end
    assert results["sequences"]["07"] == trained["sequences"]["07"]
    assert [s["trained_on"] for s in results["sequences"].values()] == [True, False]
    assert results["pooled"]["trained_on"]  # because one of them was
    assert re.findall(r"^(\w+) \*", out, re.M) == ["00", "train", "all"]
    fails_with_one_line(d3dlo.main, arguments, "--resume", capsys)  # not overwritten
    shutil.copy("data/poses/07.txt", "data/poses/00.txt")
    resume = "train --out run --resume".split()
    fails_with_one_line(d3dlo.main, resume, "the data has changed", capsys)
    assert (run / "checkpoint.pt").read_bytes() == before
    arguments = "eval --data data --weights run/checkpoint.pt".split()
    fails_with_one_line(d3dlo.main, arguments, "weights.pt beside", capsys)
    shutil.copy("run/weights.pt", "run/checkpoint.pt")
    fails_with_one_line(d3dlo.main, ["train", "--out", "run", "--resume"], "no training", capsys)


def test_training_from_weights_starts_with_them_and_keeps_the_facts_about_their_data(cwd):
    write_root(cwd / "first")
    write_root(cwd / "later", size=1200)  # another sequence of the same name
    d3dlo.train(replace(SMALL, epochs=1), "first", out="a")
    d3dlo.train(Config(epochs=1, lr=1e-12), "later", out="b", weights="a")
    (a, facts_a), (b, facts_b) = (load_weights(run) for run in "ab")
    assert b.config == replace(a.config, epochs=1, batch=16, swap="random", lr=1e-12)
    assert a.config.sa1.n_fps == 32
    for x, y in zip(a.parameters(), b.parameters(), strict=True):
        assert torch.allclose(x, y, atol=1e-9)
    assert list(facts_a["train"].values()) == facts_b["before"]
    assert facts_a["train"] != facts_b["train"]
    (low_a, high_a), (low_b, high_b) = facts_a["seen"], facts_b["seen"]
    assert np.all(np.array(low_b) <= low_a) and np.all(np.array(high_b) >= high_a)
    shutil.rmtree("a")  # resuming does not need the weights that training started from
    d3dlo.train(out="b", resume=True)
    assert load_weights("b")[1]["train"] == facts_b["train"]
    d3dlo.evaluate("first", "b", out="results")
    assert results_of("results")["sequences"]["00"]["trained_on"]


def config_of(run):
    """The Config that a training run stored, as a dict."""
    return json.loads((Path(run) / "config.json").read_text())["config"]


def test_train_with_data_defaults_to_the_papers_settings_and_logs_the_test_loss(cwd):
    write_root(cwd / "root", ("00", "03"), scans=4)
    write_root(cwd / "alone", ("00",), scans=4)  # with the same 00
    for root in ("root", "alone"):
        arguments = f"train --data {root} --epochs 2 --out {root}-run"
        assert d3dlo.main(arguments.split()) == 0
        assert config_of(f"{root}-run") == Config(epochs=2).as_dict()
    log = (cwd / "root-run" / "log.txt").read_text()
    losses = re.findall(r"^epoch (\d)/2: loss [\d.]+, test loss [\d.]+, learning", log, re.M)
    assert losses == ["1", "2"]
    assert "test loss" not in (cwd / "alone-run" / "log.txt").read_text()
    assert_same_model(stored(cwd / "root-run"), stored(cwd / "alone-run"))


@pytest.mark.parametrize("short", [True, False])
def test_training_settings_do_not_change_the_network_and_input_of_given_weights(cwd, short):
    network = dict(max_range=30.0, plane=False, sa1=SMALL.sa1._replace(n_n=5))
    save_weights("w.pt", replace(SMALL, **network, epochs=77, lr=0.5, frozen=0.5))
    write_root(cwd / "root", scans=4)
    arguments = "train --data root --weights w.pt --epochs 1 --out run" + " --short" * short
    assert d3dlo.main(arguments.split()) == 0
    ours = dict(batch=8, optimizer="muon", lr=1e-2, schedule="one-cycle", swap="both",
                augment=True, frozen=0.25)
    papers = dict(batch=16, optimizer="adam", lr=1e-3, schedule="steps", swap="random",
                  augment=False, frozen=0.0)
    expected = replace(SMALL, **network, epochs=1, **(ours if short else papers))
    assert config_of("run") == expected.as_dict()


@table("out", {"the root": "root", "poses": "root/poses", "below poses": "root/poses/new",
               "a sequence": "root/sequences/00", "a link": "link", "dots": "root/poses/../poses"})
def test_an_output_folder_inside_the_data_folder_is_refused(cwd, capsys, out):
    write_root(cwd / "root", size=60)
    (cwd / "link").symlink_to("root/poses")
    save_weights("w.pt", SMALL)
    before, folders = files_of(cwd), sorted(cwd.rglob("*"))
    for command in ("eval --weights w.pt", "train --epochs 1"):
        arguments = [*command.split(), "--data", "root", "--out", out]
        fails_with_one_line(d3dlo.main, arguments, "--out", capsys)
    assert files_of(cwd) == before and sorted(cwd.rglob("*")) == folders


def test_eval_into_the_same_folder_deletes_the_earlier_results_and_nothing_else(cwd):
    write_root(cwd / "root", ("03", "07"), size=60)
    save_weights("w.pt", SMALL)
    (cwd / "root" / "notes.txt").write_text("mine")

    def evaluate(*sequences):
        d3dlo.evaluate("root", "w.pt", sequences, "out")
        return set(os.listdir("out"))

    assert evaluate("03", "07") == {"03.txt", "07.txt", "results.json"}
    for name in ("notes.txt", "00.txt"):
        (cwd / "out" / name).write_text("mine")
    assert evaluate("07") == {"07.txt", "results.json", "notes.txt", "00.txt"}
    content = results_of("out")
    content["files"] += ["../root/notes.txt", str(cwd / "w.pt"), "gone.txt"]  # in other folders
    (cwd / "out" / "results.json").write_text(json.dumps(content))
    assert evaluate("03") == {"03.txt", "results.json", "notes.txt", "00.txt"}
    assert (cwd / "root" / "notes.txt").read_text() == "mine" and (cwd / "w.pt").exists()
    content = results_of("out")
    content["files"].append("thesis.tex")  # eval writes no such file
    (cwd / "out" / "results.json").write_text(json.dumps(content))
    (cwd / "out" / "thesis.tex").write_text("mine")
    evaluate("03")
    assert (cwd / "out" / "thesis.tex").read_text() == "mine"


@table("name, content", {
    **{f"results.json: {content}": ("results.json", content) for content in (
        "[]", '{"files": ["03.txt"]}', '{"data": "", "refine": 0, "files": null}', "no JSON")},
    "a trajectory": ("03.txt", "mine"),
    "a picture": ("plot.png", "mine")})
def test_eval_never_replaces_files_that_are_not_its_own(cwd, capsys, name, content):
    pytest.importorskip("matplotlib")
    write_root(cwd / "root", ("03",), size=60)
    save_weights("w.pt", SMALL)
    (cwd / "out").mkdir()
    (cwd / "out" / name).write_text(content)
    command = "eval --data root --weights w.pt --out out --plot".split()
    fails_with_one_line(d3dlo.main, command, name, capsys)
    assert files_of(cwd / "out") == {name: content.encode()}


def test_eval_into_the_folder_of_an_interrupted_one_replaces_its_files(cwd, monkeypatch):
    write_root(cwd / "root", ("03", "07"), size=60)
    save_weights("w.pt", SMALL)
    with monkeypatch.context() as patch:
        patch.setattr(d3dlo, "summarize", Mock(side_effect=KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            d3dlo.evaluate("root", "w.pt", ["07"], "out")
    assert set(os.listdir("out")) == {"07.txt", "results.json"}
    d3dlo.evaluate("root", "w.pt", ["03"], "out")
    assert set(os.listdir("out")) == {"03.txt", "results.json"}


def test_an_empty_option_is_refused(cwd, capsys):
    for option in ("--data", "--weights", "--out"):
        fails_with_one_line(d3dlo.main, ["eval", option, ""], f"{option} is empty", capsys)
    assert not os.listdir()


def test_eval_refines_as_often_as_asked(cwd):
    s, = kitti.open_sequences(write_root(cwd / "root", size=60))
    save_weights("w.pt", SMALL)
    assert d3dlo.main("eval --data root --weights w.pt --refine 2 --out out".split()) == 0
    got = kitti.camera_to_velo(metrics.read_poses("out/00.txt"), s.Tr)
    for refine, same in ((0, False), (1, False), (2, True), (3, False)):
        odometry = d3dlo.Odometry("w.pt", refine=refine)
        poses = [odometry.register(s.scan(i)) for i in range(6)]
        assert np.allclose(got, poses, atol=1e-3) == same


def test_the_baselines_stand_still_or_repeat_the_mean_motion_of_training(cwd, capsys):
    mean = [10.0, 1, 0, 0, 0, 3]
    s, = kitti.open_sequences(write_root(cwd / "root", ("03",), scans=15, size=60, step=14))
    save_weights("w.pt", SMALL, mean_motion=mean)
    assert d3dlo.main("eval --data root --weights w.pt --out out".split()) == 0
    out, results = capsys.readouterr().out, results_of("out")
    for name, v in {"standing still": [0] * 6, "mean training motion": mean}.items():
        motion = euler_pose(np.array(v))
        T = [np.linalg.matrix_power(motion, i) for i in range(15)]
        errors = np.linalg.inv(motion) @ s.motions()
        steps = [np.linalg.norm(errors[:, :3, 3], axis=1),
                 np.degrees(Rotation.from_matrix(errors[:, :3, :3]).magnitude())]
        segments = devkit_errors(s.poses_cam, s.Tr @ T @ np.linalg.inv(s.Tr))[:, 3:]
        expected = [*segments.mean(0), *np.mean(steps, 1)]
        for group in (results["pooled"], results["splits"]["test"]):
            got = [group[name][key] for key in ("E_t", "E_r", "t_step_m", "r_step_deg")]
            assert_allclose(got, expected, rtol=1e-6)
        assert table_row(out, f"  {name}") == as_printed(results["pooled"][name])


def test_train_applies_neighbors_and_no_plane_to_the_network(cwd):
    write_root(cwd / "root", scans=3, size=1500)
    arguments = "train --data root --neighbors 5 --no-plane --epochs 1 --out run"
    assert d3dlo.main(arguments.split()) == 0
    expected = Config(epochs=1, plane=False, sa1=Layer(1.0, 1024, 5, (4, 8, 16, 32)))
    assert load_weights("run")[0].config == expected


def test_the_seed_determines_the_initial_weights_and_the_mean_motion_is_stored(cwd):
    s, = kitti.open_sequences(write_root(cwd / "root", size=60))
    first = []
    for run, seed in enumerate((0, 0, 1)):
        d3dlo.train(replace(SMALL, epochs=1, lr=1e-12), "root", out=f"run{run}", seed=seed)
        net, state = load_weights(f"run{run}")
        first.append(net.sa2.mpn.h[0].weight.detach())
        assert_allclose(state["mean_motion"], to_vector(s.motions()).mean(0), atol=1e-6)
    assert torch.equal(first[0], first[1]) and (first[0] - first[2]).abs().max() > 0.01


def test_a_run_folder_in_use_is_refused_in_one_line_that_names_the_process(cwd):
    write_root(cwd / "root", scans=2)
    with kitti.run_folder(cwd / "run"):
        arguments = "train --data root --out run".split()
        ran = subprocess.run([sys.executable, HERE / "d3dlo.py", *arguments],
                             capture_output=True, text=True, timeout=60)
    line, = error_lines(ran.stderr)
    assert ran.returncode == 2 and f"process {os.getpid()} on" in line and "run:" in line
    assert not (cwd / "run").exists() and not (cwd / "cache").exists()


def test_a_run_is_not_resumed_after_a_scan_has_changed(cwd, capsys):
    root = write_root(cwd / "root", size=60)
    d3dlo.train(replace(SMALL, epochs=1), "root", out="run")
    change_in_the_middle(root / SCAN)
    fails_with_one_line(d3dlo.main, "train --out run --resume".split(), "data has changed", capsys)


def test_train_fails_with_one_line_when_the_loss_diverges(cwd, capsys):
    write_root(cwd / "root")
    arguments = "train --data root --epochs 50 --batch 2 --lr 1e30 --out run"
    fails_with_one_line(d3dlo.main, arguments.split(), "step 1 (learning rate 1.0e+30).", capsys)
    assert set(os.listdir("run")) == {"config.json", "lock", "log.txt"}


def test_a_run_stopped_by_a_closed_stdout_is_resumed_to_the_same_weights(
        cwd, monkeypatch, capsys):
    class Closed(io.StringIO):  # like a pipe to `head -3`
        def write(self, text):
            if "epoch 1/" in text:
                raise BrokenPipeError
            return super().write(text)

    write_root(cwd / "root", scans=4)
    arguments = "train --data root --epochs 2 --batch 2 --out".split()
    assert d3dlo.main([*arguments, "whole"]) == 0
    capsys.readouterr()
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", Closed())
        assert d3dlo.main([*arguments, "run"]) == 2
    line, = error_lines(capsys.readouterr().err)
    assert "--resume" in line and stored(cwd / "run", "checkpoint.pt")["step"] == 1
    assert d3dlo.main("train --out run --resume".split()) == 0
    assert_same_model(stored(cwd / "run"), stored(cwd / "whole"))


def test_an_interruption_while_the_cache_is_computed_leaves_no_run_folder(cwd, monkeypatch, capsys):
    def interrupt(*arguments):
        raise KeyboardInterrupt

    write_root(cwd / "root", scans=3)
    monkeypatch.setattr(kitti, "in_processes", interrupt)
    assert d3dlo.main("train --data root --out runs/run".split()) == 130
    line, = error_lines(capsys.readouterr().err)
    assert "run the same command again" in line and not (cwd / "runs").exists()


def test_a_full_disk_fails_with_one_line(cwd, monkeypatch, capsys):
    def full(*arguments, **options):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    write_root(cwd / "root", size=60)
    save_weights("w.pt", SMALL)
    monkeypatch.setattr(np, "savetxt", full)
    arguments, words = "eval --data root --weights w.pt --out out", "No space left on device: 'out/"
    fails_with_one_line(d3dlo.main, arguments.split(), words + "00.txt'", capsys)


def test_the_command_line_prints_the_version(capsys):
    with pytest.raises(SystemExit) as end:
        d3dlo.main(["--version"])
    assert end.value.code == 0 and capsys.readouterr().out == f"d3dlo {d3dlo.__version__}\n"
    assert re.fullmatch(r"\d+\.\d+\.\d+", d3dlo.__version__)


def rewrite(name, change):
    """A function of a folder that applies `change` to the bytes of a file in it."""
    return lambda root: (root / name).write_bytes(change((root / name).read_bytes()))


SCAN, POSES, CALIB = "sequences/00/velodyne/000005.bin", "poses/00.txt", "sequences/00/calib.txt"


def drop_last_word(data):
    return data.rstrip().rpartition(b" ")[0]


@table("spoil, words", {  # what to do to a good root, and what the message must contain
    "no sequences": (
        lambda root: shutil.rmtree(root / "sequences"),
        "a folder of *.bin or *.npy files, and KITTI's odometry layout, ROOT/sequences/00/"),
    "raw layout": (
        lambda root: (root / "sequences").rename(root / "2011_09_26_drive_0005_sync"),
        "kitti.py raw DRIVE ROOT"),
    "no scans": (lambda root: shutil.rmtree((root / SCAN).parent), "velodyne"),
    "a scan missing": (lambda root: (root / SCAN).with_name("000002.bin").unlink(), "000002.bin"),
    "a scan cut short": (rewrite(SCAN, lambda b: b[:-3]), SCAN),
    "an empty scan": (rewrite(SCAN, lambda b: b""), SCAN),
    "another format": (rewrite(SCAN, lambda b: b"\x93NUMPY" + b[:-6]), SCAN),
    "too few points": (rewrite(SCAN, lambda b: b[:16 * 1000]), f"{SCAN}: 1000 usable"),
    "a pose too few": (rewrite(POSES, lambda b: b"\n".join(b.splitlines()[1:])), POSES),
    "a pose of 11": (rewrite(POSES, drop_last_word), f"{POSES}, line 6: 11 words"),
    "a pose of 13": (rewrite(POSES, lambda b: b.replace(b"\n", b" 0\n", 1)),
                     f"{POSES}, line 1: 13 words"),
    "a pose of words": (rewrite(POSES, lambda b: b + b"frame 1"), f"{POSES}, line 7: 2 words"),
    "a pose at infinity": (rewrite(POSES, lambda b: drop_last_word(b) + b" inf"),
                           f"{POSES}, line 6: 12 words"),
    "a pose that is no rotation": (rewrite(POSES, lambda b: b.replace(b"\n", b"\n9", 1)),
                                   f"{POSES}: pose 1"),
    "a pose that mirrors": (rewrite(POSES, lambda b: b"-" + b), f"{POSES}: pose 0"),
    "no pose": (rewrite(POSES, lambda b: b"\n\n"), f"{POSES}: holds no pose"),
    "no calibration": (lambda root: (root / CALIB).unlink(), CALIB),
    "calibration without Tr": (rewrite(CALIB, lambda b: b.partition(b"Tr")[0]), CALIB),
    "Tr of 11": (rewrite(CALIB, drop_last_word), CALIB),
})
def test_bad_data_fails_with_one_line_and_leaves_no_files(cwd, weights, capsys, spoil, words):
    root = write_root(cwd / "root")
    spoil(root)
    evaluate = ["eval", "--data", root, "--weights", weights, "--out", "out"]
    train = ["train", "--data", root, "--epochs", 1, "--out", "run"]
    for arguments in (evaluate, train):
        fails_with_one_line(d3dlo.main, arguments, words, capsys)
    assert [name for name in files_of(cwd) if not name.startswith("root/")] == []


@pytest.mark.parametrize("T", [np.eye(4), np.zeros((3, 3, 4)), np.zeros((2, 4, 3))])
def test_poses_of_another_shape_are_not_written(tmp_path, T):
    with pytest.raises(ValueError, match="shape"):
        metrics.write_poses(tmp_path / "poses.txt", T)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("arguments, words", {  # words: what the message must contain
    "eval --data root --sequences 42": "42",
    "eval --data root --sequences ../sequences/00": "../sequences/00",
    "eval --data gone": "gone: no such folder",
    "eval --data root/poses/00.txt": "00.txt is a file",
    "eval --data pcd": "save the points of each file as .npy",
    "eval --data root --out root/poses/00.txt": "is a file",
    "eval --data root --weights gone.pt": "gone.pt",
    "eval --data root --weights root": "root/weights.pt",
    "eval --sequences 0O": "0O",  # not in the simulated city
    "eval --data root --device nonsense": "nonsense",
    "eval --data root --device meta": "device meta",
    "eval --data root --refine -1": "refine",
    "eval --data root --refine 101": "at most 100 passes",
    "train --resume": "--out",
    "train --resume --out gone": "gone",
    "train --data root --sequences test": "test",
    "train --sequences 00 0O": "0O",
    "train --data root --weights gone.pt": "gone.pt",
    "train --data root --weights gone.pt --no-plane": "--no-plane",
    "train --data root --lr 0": "lr",
    "train --data root --lr nan": "lr",
    "train --data root --neighbors 99999999": "n_n",
    f"train --data root --seed {10**23}": "seed",
    "train --data root --seed -1": "seed",
    "train --data root --device meta": "device meta",
}.items())
def test_bad_arguments_fail_with_one_line(cwd, capsys, arguments, words):
    write_root(cwd / "root")
    (cwd / "pcd").mkdir()
    (cwd / "pcd" / "0.pcd").touch()
    before = sorted(cwd.rglob("*"))
    fails_with_one_line(d3dlo.main, arguments.split(), words, capsys)
    assert sorted(cwd.rglob("*")) == before


def torch_bytes(content):
    """The bytes of a file that torch.save writes."""
    torch.save(content, "content.pt")
    return Path("content.pt").read_bytes()


def another_shape(good):
    return torch_bytes({**torch.load("good.pt"), "config": Config().as_dict()})


def other_numbers(good):
    state = torch.load("good.pt")
    model = {name: tensor + 1 for name, tensor in state["model"].items()}
    return torch_bytes(state | {"model": model})


@table("spoil", {  # the bytes of a good file -> those of a bad one
    "another shape": another_shape,
    "other numbers": other_numbers,
    "code": lambda good: pickle.dumps(Mischief(), protocol=2),
    "code by torch": lambda good: torch_bytes({"model": Mischief()}),
    "cut short": lambda good: good[:-2000],
    "no config": lambda good: torch_bytes({"model": {}}),
    "a list": lambda good: torch_bytes([1.0]),
    "noise": lambda good: generator(0).bytes(5000),
    "empty": lambda good: b"",
    "text": lambda good: b"hello",
})
def test_files_that_are_not_weights_fail_with_one_line_and_run_no_code(cwd, capsys, spoil):
    write_root(cwd / "root", size=40)
    save_weights("good.pt", SMALL)
    (cwd / "bad.pt").write_bytes(spoil((cwd / "good.pt").read_bytes()))
    arguments = "eval --data root --weights bad.pt --out out".split()
    error = fails_with_one_line(d3dlo.main, arguments, "bad.pt", capsys)
    assert "http" not in error  # torch's advice to load it nevertheless
    assert not (cwd / "out").exists() and not (cwd / "mischief").exists()


def test_metrics_on_the_command_line(cwd, capsys):
    gt, est = straight_path(300), straight_path(300, 1.01)
    files = {"gt/03": gt, "gt/07": gt[:200], "est/03": est, "est/07": gt[:200], "short": gt[:20]}
    for name, T in files.items():
        metrics.write_poses(f"{name}.txt", T)
    assert metrics.main(["short.txt", "short.txt"]) == 0
    assert table_row(capsys.readouterr().out, "short")[:4] == ["0", "-", "-", "0.0000"]

    assert metrics.main(["gt/03.txt", "est/03.txt"]) == 0
    expected, out = devkit_errors(gt, est)[:, 3], capsys.readouterr().out
    ate = math.sqrt(sum((0.01 * i) ** 2 for i in range(300)) / 300)
    assert table_row(out, "03")[5:] == [f"{ate:.3f}", "0.0100", "0.0000"]
    E_t = f"{expected.mean():.3f}"
    assert table_row(out, "03")[:5] == [str(len(expected)), E_t, "0.00000", "0.0100", "0.0000"]
    assert table_row(out, "100 m")[1] == "1.010" and table_row(out, "200 m")[1] == "1.005"

    assert metrics.main(["gt", "est"]) == 0
    without_error = devkit_errors(gt[:200], gt[:200])[:, 3]  # 07, which is shorter
    pooled = np.r_[expected, without_error]
    assert table_row(capsys.readouterr().out, "all")[1] == f"{pooled.mean():.3f}"
    for bad in (["gt/03.txt", "gone.txt"], ["gt/03.txt", "short.txt"], ["gt", "est/03.txt"],
                ["gt", str(cwd)]):
        fails_with_one_line(metrics.main, bad, bad[1], capsys)


def test_a_picture_never_replaces_the_poses_it_is_drawn_from(cwd, capsys):
    for name in ("gt/00", "est/00"):
        metrics.write_poses(f"{name}.txt", straight_path(5))
    before = files_of(cwd)
    for pair in (["gt/00.txt", "est/00.txt"], ["gt", "est"]):
        for plot in ("gt/00.txt", "est/../est/00.txt"):
            fails_with_one_line(metrics.main, [*pair, "--plot", plot], "--plot", capsys)
    assert files_of(cwd) == before


def test_simulate_on_the_command_line(cwd, city, capsys):
    arguments = ["simulate", "city", "--sequences", "07", "--scans", "8", "--azimuth", "300"]
    assert kitti.main(arguments) == 0
    assert "8 scans" in capsys.readouterr().out
    assert files_of("city").items() <= files_of(city).items()
    write_root(cwd / "real")
    before = files_of(cwd)
    for change, words in {"--azimuth 400": "07", "--azimuth 3": "azimuth", "--scans 0": "scans",
                          "--sequences ../x": "../x"}.items():
        fails_with_one_line(kitti.main, arguments + change.split(), words, capsys)
    # Scans of an earlier city are refused, and the message says what to do
    made = cwd / "city" / "sequences" / "07" / "simulated.json"
    settings = made.read_text()
    made.write_text(settings.replace(f'"city": {kitti.CITY}', '"city": 3'))
    fails_with_one_line(kitti.main, arguments, "delete or rename that folder", capsys)
    made.write_text(settings)
    # Real data are never overwritten
    over_real_data = "simulate real --sequences 00 --scans 2".split()
    fails_with_one_line(kitti.main, over_real_data, "00", capsys)
    assert files_of(cwd) == before and not list(cwd.rglob(".*"))


DRIVE = "2011_09_26/2011_09_26_drive_0013_sync"


def imu_pose(t):
    """T_wi (4,4) of the vehicle of `write_raw` after t seconds: 12 m/s on a climbing bend."""
    yaw, radius = 0.4 + 0.3 * t, 12 / 0.3
    position = [radius * np.sin(yaw), -radius * np.cos(yaw), 100 + 0.5 * t]  # east, north, up
    return euler_pose(np.r_[position, np.degrees([0.03, 0.05, yaw])])


def write_raw(folder, scans=12):
    """Write a drive in the layout of KITTI's raw data.

    Returns the true poses of the rectified camera (scans,4,4) and Tr (4,4).
    """
    rng, drive = generator(0), folder / DRIVE
    times = {"velodyne_points": 0.1 * np.arange(scans) + rng.uniform(-0.004, 0.004, scans)}
    times["oxts"] = times["velodyne_points"] + 0.015 + rng.uniform(-0.01, 0.01, scans)
    for stream, seconds in times.items():
        (drive / stream / "data").mkdir(parents=True)
        # The drive goes on past midnight
        stamps = np.datetime64("2011-09-26T23:59:59.5", "ns") + (1e9 * seconds).astype(int)
        lines = [f"{stamp}\n".replace("T", " ") for stamp in stamps]
        (drive / stream / "timestamps.txt").write_text("".join(lines))

    T_oxts = [imu_pose(t) for t in times["oxts"]]
    scale = 6378137 * np.cos(np.radians(49))  # of Mercator at the first packet's latitude
    for i, (t, T) in enumerate(zip(times["oxts"], T_oxts)):
        random_scan(rng, 40).tofile(drive / "velodyne_points" / "data" / f"{i:010d}.bin")
        east, north, up = T[:3, 3] - T_oxts[0][:3, 3]
        mercator_y = np.arctanh(np.sin(np.radians(49))) + north / scale
        lat, lon = np.degrees(np.arcsin(np.tanh(mercator_y))), 8.4 + np.degrees(east / scale)
        yaw = 0.4 + 0.3 * t
        velocity = 12 * np.sin(yaw), 12 * np.cos(yaw)
        packet = np.full(30, 77.0)  # the value of all fields that are not used
        packet[:11] = lat, lon, up, 0.03, 0.05, yaw, *velocity, 77, 77, 0.5
        packet[17:20] = T[:3, :3].T @ [0, 0, 0.3]  # along the vehicle's axes
        np.savetxt(drive / "oxts" / "data" / f"{i:010d}.txt", packet[None], fmt="%.17g")

    T_velo_imu = random_motion(rng)
    T_cam_velo = euler_pose(np.array([0, -0.1, -0.3, -90, 1, -91]))
    rectify = euler_pose(np.array([0, 0, 0, 1, 2, 3.0]))

    def numbers(array):
        return " ".join(map(repr, array.ravel().tolist()))

    for name, T in ("imu_to_velo", T_velo_imu), ("velo_to_cam", T_cam_velo):
        (drive.parent / f"calib_{name}.txt").write_text(
            f"calib_time: 25-May-2012\nR: {numbers(T[:3, :3])}\nT: {numbers(T[:3, 3])}\n")
    (drive.parent / "calib_cam_to_cam.txt").write_text(
        f"R_00: {numbers(np.eye(3))}\nR_rect_00: {numbers(rectify[:3, :3])}\n")
    T_imu_cam = np.linalg.inv(rectify @ T_cam_velo @ T_velo_imu)
    T_wc = [imu_pose(t) @ T_imu_cam for t in times["velodyne_points"]]
    return np.linalg.inv(T_wc[0]) @ T_wc, rectify @ T_cam_velo


def test_a_raw_drive_is_converted_with_poses_at_the_times_of_its_scans(cwd, capsys):
    truth, Tr = write_raw(cwd)
    assert kitti.main(["raw", DRIVE, "root"]) == 0
    out, err = capsys.readouterr()
    s, = kitti.open_sequences("root")
    assert s.name == "2011_09_26_drive_0013" and error_lines(err) == []
    assert "root: 1 sequences, 12 scans" in out and "split" not in out
    assert re.search(r"scans 0 to 11, 13\.\d m", out)  # 1.1 s at 12 m/s: 13.2 m
    assert_allclose(s.Tr, Tr, atol=1e-9)
    assert_allclose(s.poses_cam, truth, atol=1e-3)  # 1 mm
    assert metrics.step_errors(truth, s.poses_cam).max() < 1e-3
    assert_allclose(np.loadtxt(s.folder / "times.txt"), 0.1 * np.arange(12), atol=0.01)
    for scan, path in zip(sorted((cwd / DRIVE).rglob("*.bin")), s.scan_paths, strict=True):
        assert path.samefile(scan)  # a link, not a copy
    before = files_of(cwd)
    fails_with_one_line(kitti.main, ["raw", DRIVE, "root"], "drive_0013 already exists", capsys)
    assert files_of(cwd) == before


def test_scans_of_a_raw_drive_are_copied_if_they_cannot_be_linked(cwd, monkeypatch):
    write_raw(cwd)
    before = files_of(DRIVE)
    def refuse(source, target):
        raise OSError("Invalid cross-device link")

    monkeypatch.setattr(os, "link", refuse)
    assert kitti.convert_raw(DRIVE, "root") == {"2011_09_26_drive_0013": (0, 11)}
    s, = kitti.open_sequences("root")
    for i, path in enumerate(s.scan_paths):
        assert path.read_bytes() == before[f"velodyne_points/data/{i:010d}.bin"]
    assert files_of(DRIVE) == before


def delete(pattern, numbers=(0,)):
    """A function of a drive that deletes the files of these numbers."""
    def spoil(drive):
        for i in numbers:
            (drive / pattern.format(i)).unlink()

    return spoil


def blank_lines(name, numbers):
    """A function of a drive that empties these lines of a file."""
    def spoil(drive):
        lines = (drive / name).read_text().splitlines()
        kept = ["" if i in numbers else line for i, line in enumerate(lines)]
        (drive / name).write_text("\n".join(kept))

    return spoil


@table("spoil, parts", {  # what to delete, and the first and last scan of each sequence
    "scans": (delete("velodyne_points/data/{:010d}.bin", (3, 4)), [(0, 2), (5, 11)]),
    "a time": (blank_lines("velodyne_points/timestamps.txt", [7]), [(0, 6), (8, 11)]),
    "packets": (delete("oxts/data/{:010d}.txt", (4, 5, 6)), [(0, 4), (7, 11)]),
    "times of packets": (blank_lines("oxts/timestamps.txt", (4, 5, 6)), [(0, 4), (7, 11)]),
})
def test_a_raw_drive_is_split_where_something_is_missing(cwd, capsys, spoil, parts):
    truth, _ = write_raw(cwd)
    spoil(cwd / DRIVE)
    assert kitti.main(["raw", DRIVE, "root"]) == 0
    out, sequences = capsys.readouterr().out, kitti.open_sequences("root")
    assert "split" in out
    assert [s.name for s in sequences] == ["2011_09_26_drive_0013-1", "2011_09_26_drive_0013-2"]
    for s, (first, last) in zip(sequences, parts, strict=True):
        assert f"{s.name}: scans {first} to {last}" in out
        assert_allclose(s.poses_cam, np.linalg.inv(truth[first]) @ truth[first:last + 1], atol=1e-3)
        assert s.scan_paths[-1].samefile(f"{DRIVE}/velodyne_points/data/{last:010d}.bin")


SYNC, CALIBRATION = "2011_09_26_drive_0013_sync.zip", "2011_09_26_calib.zip"
PACKET = "oxts/data/0000000005.txt"


@table("spoil, words", {  # what to do to a good drive, and what the message must contain
    "no drive": (shutil.rmtree, ("velodyne_points/timestamps.txt", SYNC)),
    "no scans": (lambda drive: shutil.rmtree(drive / "velodyne_points" / "data"),
                 ("velodyne_points/data/0000000000.bin", SYNC)),
    "no packets": (lambda drive: shutil.rmtree(drive / "oxts" / "data"),
                   ("oxts/data/0000000000.txt", SYNC)),
    "no times of scans": (delete("velodyne_points/timestamps.txt"),
                          ("velodyne_points/timestamps.txt", SYNC)),
    "no times of packets": (delete("oxts/timestamps.txt"), ("oxts/timestamps.txt", SYNC)),
    "no imu_to_velo": (delete("../calib_imu_to_velo.txt"), ("calib_imu_to_velo.txt", CALIBRATION)),
    "no velo_to_cam": (delete("../calib_velo_to_cam.txt"), ("calib_velo_to_cam.txt", CALIBRATION)),
    "no cam_to_cam": (delete("../calib_cam_to_cam.txt"), ("calib_cam_to_cam.txt", CALIBRATION)),
    "too few times": (write_as("oxts/timestamps.txt", "2011-09-26 13:10:51.1\n"),
                      ("oxts/timestamps.txt is damaged", SYNC)),
    "words for times": (write_as("oxts/timestamps.txt", "noon\n" * 12), ("oxts/timestamps.txt",)),
    "blank times": (write_as("velodyne_points/timestamps.txt", "\n" * 12),
                    ("velodyne_points/timestamps.txt is damaged", SYNC)),
    "packets of another day": (write_as("oxts/timestamps.txt", "2011-09-28 13:10:51.1\n" * 12),
                               (DRIVE, "within 0.1 s", SYNC)),
    "a packet of 29": (rewrite(PACKET, lambda b: b.rpartition(b" ")[0]), (PACKET, "30")),
    "a packet with NaN": (rewrite(PACKET, lambda b: b"nan" + b[b.index(b" "):]), (PACKET, "30")),
    "a scan cut short": (rewrite("velodyne_points/data/0000000007.bin", lambda b: b[:-1]),
                         ("0000000007.bin",)),
    "no rotation": (rewrite("../calib_velo_to_cam.txt", lambda b: b.replace(b"R:", b"S:")),
                    ("calib_velo_to_cam.txt is damaged", CALIBRATION)),
    "no translation": (rewrite("../calib_imu_to_velo.txt", lambda b: b.replace(b"T:", b"U:")),
                       ("calib_imu_to_velo.txt is damaged", CALIBRATION)),
})
def test_an_incomplete_or_damaged_raw_drive_fails_with_one_line(cwd, capsys, spoil, words):
    write_raw(cwd)
    spoil(cwd / DRIVE)
    code, err = kitti.main(["raw", DRIVE, "root"]), capsys.readouterr().err
    assert code == 2 and len(error_lines(err)) == 1 and "Traceback" not in err, err
    assert all(word in err for word in words), err
    assert not (cwd / "root").exists()  # no new files


def test_a_folder_that_is_not_a_raw_drive_fails_with_one_line(cwd, capsys):
    for name in ("gone", ".", "2011_09_26_drive_0013_extract"):
        words = f"{name} is not a drive of KITTI's raw data"
        fails_with_one_line(kitti.main, ["raw", name, "root"], words, capsys)
    assert not any(cwd.iterdir())


SCRIPT = """
import multiprocessing, sys, d3dlo
if __name__ == "__main__":
    multiprocessing.set_start_method("spawn")
    arguments = ["eval", "--data", "data", "--weights", {weights!r}, "--out", "o\u00f9"]
    sys.exit(d3dlo.main(arguments))
"""


def test_eval_works_with_read_only_data_non_ascii_paths_no_home_and_spawned_workers(
        tmp_path, weights):
    folder = tmp_path / "o\u00f9 \u00e7a \u6f22"
    folder.mkdir()
    environment = {"PATH": os.environ.get("PATH", ""), "PYTHONPATH": str(HERE), "LC_ALL": "C"}

    def python(*arguments):
        command = [sys.executable, *map(str, arguments)]
        ran = subprocess.run(command, cwd=folder, env=environment, stdin=subprocess.DEVNULL,
                             capture_output=True, timeout=300)
        return ran.returncode, ran.stdout.decode(), ran.stderr.decode()

    # Importing prints and writes nothing
    assert python("-c", "import d3dlo") == (0, "", "") and not any(folder.iterdir())
    rewrite(SCAN, lambda b: b[:16 * 1000])(write_root(folder / "bad"))
    code, out, err = python(HERE / "d3dlo.py", "eval", "--data", "bad", "--weights", weights)
    assert (code, out, len(error_lines(err))) == (2, "", 1) and SCAN in error_lines(err)[0]

    for path in write_root(folder / "data").rglob("*"):
        path.chmod(0o555 if path.is_dir() else 0o444)
    script = SCRIPT.format(weights=str(weights))
    (folder / "run.py").write_text(script, encoding="utf-8")
    code, out, err = python("run.py")
    assert code == 0 and not error_lines(err), err
    assert [path.name for path in folder.glob("o\u00f9/*.txt")] == ["00.txt"], err


def test_metrics_draws_a_picture_if_matplotlib_is_installed(cwd, monkeypatch, capsys):
    motions = random_motion(generator(0), [1, 0.1, 0.1, 0.1, 0.1, 1], n=150)
    T = d3dlo.accumulate(motions)
    metrics.write_poses("gt.txt", T)
    arguments = ["gt.txt", "gt.txt", "--plot", "a.png"]
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "matplotlib.figure", None)  # as if it were not installed
        fails_with_one_line(metrics.main, arguments, "matplotlib", capsys)

    pytest.importorskip("matplotlib")
    figures, new_figure = [], metrics.new_figure

    def remember(*size):
        figures.append(new_figure(*size))
        return figures[-1]

    monkeypatch.setattr(metrics, "new_figure", remember)
    assert metrics.main(arguments) == 0
    metrics.draw("b.png", {"11": (None, T)})  # without ground truth
    for name in ("a.png", "b.png"):
        assert Path(name).read_bytes().startswith(b"\x89PNG")
    # Without ground truth there are no errors, so only the path is drawn
    assert [len(figure.axes) for figure in figures] == [3, 1]
    for figure in figures:  # the poses are those of a LiDAR: x forward, y left
        above = figure.axes[0]
        assert_allclose(above.lines[-2].get_xydata(), np.c_[-T[:, 1, 3], T[:, 0, 3]], atol=1e-6)
        assert above.get_ylabel() == "LiDAR x, forward [m]"
        assert all(axis.get_xlabel() and axis.get_ylabel() for axis in figure.axes)


# ------------------------------------------------------------------------------------------------
# The paper's experiments

experiments = SimpleNamespace(**runpy.run_path(str(HERE / "benchmarks" / "experiments.py")))
TWO_BALLS = replace(SMALL, sa1=Layer(2.0, 32, 12, (4, 8, 16)))  # 12 within 2 m, 3 within 1 m
REJECTED = {"quaternion": (experiments.Quaternion, SMALL),
            "coordinates": (experiments.Coordinates, SMALL),
            "two scales": (experiments.TwoScales, TWO_BALLS)}


@table("network, parameters", {
    "quaternion": (experiments.Quaternion, 61290 + 65),
    "coordinates": (experiments.Coordinates, 61290 + 3 * 64),
    # A second SA1, and 2 x 32 more input features of FE's first layer, which is 32 wide
    "two scales": (experiments.TwoScales, 61290 + 868 + 2 * 32 * 32)})
def test_rejected_networks_have_the_expected_number_of_parameters(network, parameters):
    for config in (Config(), Config(**experiments.TWO_SCALES)):  # independent of the neighbours
        assert count(network(config)) == parameters


@table("network, config", REJECTED)
@pytest.mark.parametrize("training", [True, False])
@given(seed=SEED)
@settings(max_examples=10)
def test_the_fast_version_of_a_rejected_network_equals_the_plain_one(
        training, network, config, seed):
    rng = generator(seed)
    net = random_net(rng, config, network).double()
    batch = in_double(random_batch(rng, config)[0])
    y_hat, fast, _ = compare_fast_and_plain(net, batch, training, rng)
    assert y_hat.std(0).max() > 1e-3  # predictions of different pairs differ
    slow = {d3dlo.MiniPointNet, d3dlo.SetAbstraction, d3dlo.FlowEmbedding}
    assert not slow & {type(module) for module in fast.modules()}


@given(SEED, st.sampled_from([200, 600, 3000]))
def test_two_scales_group_both_balls_as_group_ball_does(seed, N):
    rng = generator(seed)
    scan, mpn = random_scan(rng, N), random_net(rng, TWO_BALLS, experiments.TwoScales).sa1.mpn
    xyz = scan[:, :3]
    centroids = farthest_point_sampling(xyz, 32)

    def features(r, n_n):
        idx = group_ball(xyz, centroids, r, n_n)
        offsets = xyz[idx] - xyz[centroids][:, None]
        return torch.from_numpy(np.concatenate([scan[idx, 3:], offsets], -1))

    expected = torch.cat([mpn.small(features(1.0, 3)), mpn.large(features(2.0, 12))], -1)
    group = torch.from_numpy(scan_geometry(scan, TWO_BALLS)["group_sa1"])
    torch.testing.assert_close(mpn(group[None])[0], expected, rtol=1e-5, atol=1e-5)
    assert expected.shape == (32, 2 * 16)


@given(SEED)
def test_coordinates_of_the_centroids_reach_the_mini_pointnet(seed):
    rng = generator(seed)
    net, batch = random_net(rng, SMALL, experiments.Coordinates), random_batch(rng)[0]
    seen = {}
    net.sa3.sa.register_forward_hook(lambda module, inputs, output: seen.update(sa3=output))
    net.mpn.register_forward_pre_hook(lambda module, inputs: seen.update(mpn=inputs[0]))
    net(batch)
    expected = torch.cat([seen["sa3"], batch.xyz[batch.p][:, :8] / 10], -1)
    torch.testing.assert_close(seen["mpn"], expected, rtol=0, atol=0)


@given(SEED)
def test_only_the_coordinates_variant_depends_on_a_common_shift_of_both_scans(seed):
    rng = generator(seed)
    batch = in_double(random_batch(rng)[0])
    shifted = batch._replace(xyz=batch.xyz + torch.tensor([20.0, -10.0, 0.0]))
    changes = {}
    with torch.no_grad():
        for network in (D3DLO, experiments.Coordinates):
            net = random_net(rng, SMALL, network).double()
            changes[network] = (net(shifted) - net(batch)).abs().max()
    assert changes[D3DLO] < 1e-9 and changes[experiments.Coordinates] > 1e-3


def l1(y_hat, y):
    """Eq. 2."""
    return np.mean(np.abs(y_hat - y))


def eq_5(y_hat, y):
    """Eq. 5, the mean over the pairs. A length below 0.001 counts as 0.001."""
    lengths = [np.maximum(np.linalg.norm(part, axis=1), 1e-3) for part in (y_hat, y)]
    return np.mean(1 - np.sum(y_hat * y, 1) / lengths[0] / lengths[1])


def uncertainty(y_hat, y, s_t, s_r):
    """Eq. 2 of translation and rotation, weighted by the learned s_t and s_r."""
    t, r = slice(None, 3), slice(3, None)
    weighted = l1(y_hat[:, t], y[:, t]) * np.exp(-s_t) + l1(y_hat[:, r], y[:, r]) * np.exp(-s_r)
    return weighted + s_t + s_r


LOSSES = [
    ("loss", "eq. 2", l1),
    ("loss", "eq. 2 + eq. 5", lambda y_hat, y: l1(y_hat, y) + eq_5(y_hat, y)),
    ("loss", "eq. 2 + 0.1 eq. 5", lambda y_hat, y: l1(y_hat, y) + 0.1 * eq_5(y_hat, y)),
    ("loss", "eq. 2 + eq. 5 of the translation",
     lambda y_hat, y: l1(y_hat, y) + eq_5(y_hat[:, :3], y[:, :3])),
    ("loss", "uncertainty weighting", uncertainty),
    ("output", "quaternion", l1),
    ("output", "quaternion, uncertainty weighting", uncertainty),
]


@table("experiment, name, definition", {
    f"{experiment}: {name}": (experiment, name, definition)
    for experiment, name, definition in LOSSES})
@given(seed=SEED, speed=st.sampled_from([0, 1]), prediction=st.sampled_from([-1, 0, 1e-4, 1]),
       noise=st.sampled_from([0, 1]))
def test_every_loss_follows_its_definition_and_has_finite_gradients(
        experiment, name, definition, seed, speed, prediction, noise):
    rng, variant = generator(seed), experiments.EXPERIMENTS[experiment][name]
    # The target stands still or moves; the prediction may be equal to it or opposite
    y = variant.network.encode(random_motion(rng, speed, n=5))
    y_hat = prediction * y + noise * rng.normal(size=y.shape)
    objective = variant.objective().double()
    learned = [float(x) for w in objective.parameters() for x in w.data.normal_()]
    y_hat_tensor = torch.from_numpy(y_hat).requires_grad_()
    loss = objective(y_hat_tensor, torch.from_numpy(y))
    if variant.network is experiments.Quaternion:  # q and -q are the same rotation: the nearer one
        minus_q = y * [1, 1, 1, -1, -1, -1, -1]
        y = np.stack([min(a, b, key=lambda target, p=p: np.linalg.norm(target - p))
                      for a, b, p in zip(y, minus_q, y_hat)])
    assert_allclose(loss.item(), definition(y_hat, y, *learned), rtol=1e-9, atol=1e-9)
    gradients = torch.autograd.grad(loss, [y_hat_tensor, *objective.parameters()])
    assert all(gradient.isfinite().all() for gradient in gradients)


@given(SEED)
def test_quaternions_survive_the_round_trip_and_minus_q_is_the_same_rotation(seed):
    T, network = random_motion(generator(seed), (2, 1, 1, 60, 30, 60), n=4), experiments.Quaternion
    y = network.encode(T)
    assert_allclose(np.linalg.norm(y[:, 3:], axis=1), 1, atol=1e-12)
    for same in (y, y * ([1] * 3 + [-1] * 4)):
        assert_allclose(network.decode(same), T, atol=1e-9)


@given(SEED)
def test_predicted_quaternions_have_unit_length_and_their_sign_does_not_affect_the_loss(seed):
    rng = generator(seed)
    net, (batch, T) = random_net(rng, SMALL, experiments.Quaternion), random_batch(rng)
    y_hat, y = net(batch), torch.from_numpy(net.encode(T)).float()
    torch.testing.assert_close(y_hat[:, 3:].norm(dim=1), torch.ones(len(y)))
    loss = experiments.QuaternionLoss(d3dlo.UnweightedLoss())
    minus = torch.tensor([1.0, 1, 1, -1, -1, -1, -1])
    torch.testing.assert_close(loss(y_hat * minus, y), loss(y_hat, y))
    torch.testing.assert_close(loss(y_hat, y * minus), loss(y_hat, y))


@pytest.mark.parametrize("experiment", experiments.EXPERIMENTS)
def test_runs_of_an_experiment_differ_and_have_the_same_number_of_pair_steps(experiment):
    variants = experiments.EXPERIMENTS[experiment]
    pairs, budget, facts = 100, 1500, []
    for variant in variants.values():
        config = experiments.config_of(variant.changes, pairs, budget)
        assert Config(**config.as_dict()) == config
        per_batch = config.batch * (1 + (config.swap == "both"))
        steps = config.epochs * pairs * (1 + (config.swap == "both"))
        facts.append((steps, per_batch))
    assert len(variants) > 1 and len(set(facts)) == 1 and abs(facts[0][0] - budget) <= pairs
    rows = experiments.plan([experiment], pairs, budget, [0, 1], Path("out"), "data")[experiment]
    assert len({run.folder for runs in rows.values() for run in runs}) == 2 * len(variants)


def test_table_2_has_every_combination_of_neighbours_and_plane():
    rows = [Config(**variant.changes) for variant in experiments.EXPERIMENTS["table2"].values()]
    combinations = {(config.sa1.n_n, config.plane) for config in rows}
    assert combinations == {(n, plane) for n in (8, 16, 32, 64, 128) for plane in (True, False)}


def test_effects_are_differences_of_means_and_slopes_of_regressions(tmp_path):
    rng = generator(0)
    rows = experiments.plan(["table2"], 100, 1500, [0, 1], tmp_path, "data")["table2"]
    runs = [run for of_seeds in rows.values() for run in of_seeds]
    plane = np.array([run.config.plane for run in runs], float)
    doublings = np.log2([run.config.sa1.n_n for run in runs])
    y = 8 - 0.3 * plane + 0.2 * doublings + 0.1 * rng.standard_normal(len(runs))
    for run, E_t in zip(runs, y):
        metrics.write_json(run.folder / "all" / "results.json", dict(
            pooled=dict(zip(experiments.DIGITS, (E_t, 0, 1, 2))),
            splits=dict(test=dict(zip(experiments.DIGITS, (-E_t, math.nan, 1, 2))))))

    (b, c), half_widths = (values[:, 0] for values in experiments.effects(rows, "all"))
    assert np.isclose(b, y[plane == 1].mean() - y[plane == 0].mean())
    assert np.isclose(c, stats.linregress(doublings, y).slope)
    others = y - c * doublings, y - b * plane  # without the other effect
    for half_width, x, rest in zip(half_widths, (plane, doublings), others):
        # linregress counts one degree of freedom more
        error = stats.linregress(x, rest).stderr * np.sqrt((len(runs) - 2) / (len(runs) - 3))
        assert np.isclose(half_width, stats.t.ppf(0.975, len(runs) - 3) * error)
    assert np.isclose(experiments.effects(rows, "test")[0][:, 0], (-b, -c)).all()
    table = experiments.effects_in_markdown(rows)
    assert f"| the plane | test | {-b:+.3f} ± {half_widths[0]:.3f} | - |" in table


def test_experiments_share_runs_but_not_across_data_or_budgets(tmp_path):
    def folders(budget=1500, data="data"):
        plan = experiments.plan(experiments.EXPERIMENTS, 100, budget, [0], tmp_path, data)
        return {experiment: [run.folder for runs in rows.values() for run in runs]
                for experiment, rows in plan.items()}

    runs = folders()
    assert runs == folders()
    of_table_3 = runs.pop("table3")
    assert len({folders[0] for folders in runs.values()}) == 1  # all begin with Table 1 and eq. 2
    assert of_table_3[0] == runs["table2"][0] and set(of_table_3) < set(runs["table2"])
    for other in (folders(budget=3000), folders(data="other")):
        assert not set(sum(runs.values(), [])) & set(sum(other.values(), []))


@given(SEED, st.integers(1, 12))
def test_a_cache_with_more_neighbours_serves_fewer(seed, n_n):
    rng = generator(seed)
    wide = replace(SMALL, sa1=SMALL.sa1._replace(n_n=12))
    config = replace(SMALL, sa1=SMALL.sa1._replace(n_n=n_n))
    scans = [random_scan(rng, 200) for _ in range(4)]
    expected = np.stack([scan_geometry(scan, config) for scan in scans])
    nearest = experiments.Nearest(np.stack([scan_geometry(scan, wide) for scan in scans]), config)
    assert len(nearest) == 4 and nearest[1:3].dtype == expected.dtype
    assert nearest[1:3].tobytes() == expected[1:3].tobytes()
    assert nearest[3].tobytes() == expected[3].tobytes()
    for name in expected.dtype.names:
        assert_array_equal(nearest[name], expected[name])


def test_runs_share_the_cache_with_most_neighbours_of_the_same_geometry(cwd, monkeypatch):
    configs = [Config(**variant.changes) for rows in experiments.EXPERIMENTS.values()
               for variant in rows.values()]
    caches = {experiments.widest(config, configs) for config in configs}
    facts = sorted((config.sa1.r, config.sa1.n_n, config.plane) for config in caches)
    assert facts == [(1.0, 128, False), (1.0, 128, True), (2.0, 32, True)]

    monkeypatch.setattr(d3dlo, "load_geometry", d3dlo.load_geometry)
    sequences = kitti.open_sequences(write_root(cwd / "root"))
    (expected,), fingerprints = d3dlo.load_geometry(sequences, SMALL, "cache of SMALL")
    experiments.share_cache(12)
    (records,), others = d3dlo.load_geometry(sequences, SMALL)
    assert records[:].tobytes() == expected.tobytes() and others == fingerprints
    other = replace(SMALL, sa1=SMALL.sa1._replace(n_n=3))
    d3dlo.load_geometry(sequences, other)
    assert len(list(Path("cache").iterdir())) == 1


IDENTITY = b"1 0 0 0 0 1 0 0 0 0 1 0\n"


@table("change", {  # what to do to the data
    "a scan is longer": rewrite(SCAN, lambda data: data + data[:16]),
    "another first point": rewrite(SCAN, lambda data: data[16:32] + data[16:]),
    "a pose is added and one removed":
        rewrite(POSES, lambda data: data.partition(b"\n")[2] + IDENTITY),
    "another calibration":
        rewrite(CALIB, lambda data: data.partition(b"Tr:")[0] + b"Tr: " + IDENTITY)})
def test_the_fingerprint_depends_on_the_data_alone(tmp_path, change):
    def fingerprint(root):
        return experiments.fingerprint(*kitti.open_sequences(root))

    root = write_root(tmp_path / "root")
    copied = shutil.copytree(root, tmp_path / "copy")
    os.utime(copied / SCAN, (1, 1))
    assert fingerprint(copied) == fingerprint(root)
    change(copied)
    assert fingerprint(copied) != fingerprint(root)


@table("network, config", REJECTED)
def test_a_rejected_network_is_trained_stored_loaded_resumed_and_evaluated(cwd, network, config):
    write_root(cwd / "root")
    objective = experiments.UncertaintyLoss()
    if network is experiments.Quaternion:
        objective = experiments.QuaternionLoss(objective)
    d3dlo.train(replace(config, epochs=2, batch=3), "root", out="run", network=network,
                objective=objective)
    net, state = load_weights("run", network)
    assert type(net) is network and net.config.sa1.n_n == config.sa1.n_n
    for name, tensor in net.state_dict().items():
        assert torch.equal(tensor, state["model"][name])
    with pytest.raises(ValueError, match="run/weights.pt"):
        load_weights("run")  # needs `network`
    learned = stored(cwd / "run", "checkpoint.pt")["objective"]
    assert len(learned) == 1 and all(w.abs().min() > 0 for w in learned.values())  # 0 at the start
    for w in objective.parameters():
        w.data.zero_()
    d3dlo.train(out="run", resume=True, network=network, objective=objective)
    for name, tensor in objective.state_dict().items():
        assert torch.equal(tensor, learned[name])
    assert torch.equal(net.mlp[-1].weight, load_weights("run", network)[0].mlp[-1].weight)
    d3dlo.evaluate("root", "run", out="results", network=network)
    results = results_of("results")
    assert results["sequences"]["00"]["trained_on"] and results["pooled"]["t_step_m"] > 0


# ------------------------------------------------------------------------------------------------
# The documentation


def test_python_in_the_documentation_runs_and_its_commands_parse(cwd, monkeypatch):
    def parse_only(parser, arguments=None, parse=argparse.ArgumentParser.parse_args):
        parse(parser, arguments)  # raises SystemExit(2) if they are invalid
        raise SystemExit("parsed")

    pages = [HERE / "README.md", *sorted(HERE.glob("docs/*.md"))]
    text = "\n".join(page.read_text(encoding="utf-8") for page in pages)
    for block in re.findall(r"```python\n(.*?)```", text, re.S):
        exec(compile(block, "a page", "exec"), {})
    commands = re.findall(r"^(?:pip install \S+ && )?python (\S+\.py)([^#\n]*)", text, re.M)
    commands += re.findall(r"`python (\S+\.py)([^`]*)`", text)
    assert len(commands) > 20
    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parse_only)
    monkeypatch.syspath_prepend(HERE / "benchmarks")  # its scripts import each other
    for script, arguments in commands:
        monkeypatch.setattr(sys, "argv", [script, *arguments.split()])
        with pytest.raises(SystemExit, match="parsed"):
            runpy.run_path(str(HERE / script), run_name="__main__")
