"""Properties of D3DLO. Every expectation comes from an independent source: brute force, SciPy, a definition written out, or a closed
form. Real data are optional: D3DLO_KITTI names a folder in KITTI odometry layout; without it those tests are skipped."""
import argparse, contextlib, copy, errno, io, json, math, os, pickle, re, runpy, shutil, signal
import subprocess, sys, time, warnings, zipfile
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from hypothesis import HealthCheck, given, settings, strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from scipy.spatial.distance import cdist
from torch.optim.swa_utils import update_bn

import d3dlo, kitti, metrics
from d3dlo import D3DLO, Config, Layer, farthest_point_sampling, fps_textbook, group_ball, group_knn, load_geometry, load_weights, scan_geometry
from kitti import from_vector, invert, to_vector

settings.register_profile("d3dlo", deadline=None, derandomize=True, database=None, max_examples=25,
                          suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
settings.load_profile("d3dlo")

SEED = st.integers(0, 2 ** 32 - 1)
HERE = Path(__file__).resolve().parent
KITTI = Path(os.environ.get("D3DLO_KITTI", "no folder")).resolve()        # real data in KITTI's layout, for whoever has some
# every kind of layer, a hundredth of the work
SMALL = Config(sa1=Layer(2.0, 32, 4, (4, 8, 16)), fe=Layer(None, None, 6, (16, 32)), sa2=Layer(4.0, 16, 8, (32, 32)),
               sa3=Layer(8.0, 8, 4, (32, 32)), mpn=Layer(None, None, None, (32, 64)), mlp=Layer(None, None, None, (32, 6)),
               max_range=50.0, swap="both")
generator = np.random.default_rng
# What a weights file says about its training data; any scan looks like them.
FACTS = dict(train={}, before=[], mean_motion=[1.0, 0, 0, 0, 0, 0],
             seen=[[1.0, 0.1, 1.0, 0.01], [1e6, 1.0, 100.0, 1.0]])


def table(arguments, cases):
    """Parametrize by {name of the case: values}."""
    return pytest.mark.parametrize(arguments, cases.values(), ids=cases)


def cloud(rng, n):
    """A scan (n,4) in a flat box of 16 m."""
    return np.c_[rng.uniform(-8, 8, (n, 2)), rng.uniform(-2, 2, n), rng.random(n)].astype(np.float32)


def motion(rng, scale=(0.5, 0.2, 0.1, 0.5, 0.5, 2.0), n=None):
    return from_vector(rng.normal(size=6 if n is None else (n, 6)) * scale)


def trajectory(rng, n, scale=(2.5, 0.3, 0.1, 0.3, 0.3, 3.0)):
    return d3dlo.accumulate(from_vector(np.abs(rng.normal(size=(n - 1, 6))) * scale * [1, *rng.choice([-1, 1], 5)]))


def move(T, xyz):
    return xyz @ T[:3, :3].T + T[:3, 3]


def moved_scan(T, scan):
    return np.c_[move(T, scan[:, :3].astype(float)), scan[:, 3]].astype(np.float32)


def pairs_of_scans(rng, n, points=64, config=SMALL):
    """Random clouds and themselves moved, each pair a sequence of two scans: geometry and motions as `fit` takes them."""
    clouds, motions = [cloud(rng, points) for _ in range(n)], motion(rng, n=n)
    scans = [(p, moved_scan(invert(T), p)) for p, T in zip(clouds, motions)]
    return [np.stack([scan_geometry(s, config) for s in pair]) for pair in scans], list(motions[:, None])


def drives():
    """Two sequences of six unrelated scans, for whatever does not ask what is learned."""
    rng = generator(0)
    geometry = [np.stack([scan_geometry(cloud(rng, 48), SMALL) for _ in range(6)]) for _ in range(2)]
    return geometry, [motion(rng, n=5) for _ in range(2)]


def a_batch(rng, config=SMALL, pairs=3):
    """A Batch and the poses of its pairs, as training sees them."""
    geometry, motions = pairs_of_scans(rng, pairs, config.sa1.n_fps + 76, config)
    return d3dlo.training_batch(geometry, motions, [(i, 0) for i in range(pairs)], config, rng)


def in_double(batch):
    return batch._replace(xyz=batch.xyz.double(), group_sa1=batch.group_sa1.double())


def norms_of(net):
    return [module for module in net.modules() if hasattr(module, "running_mean")]


def a_net(rng, config=SMALL, network=D3DLO):
    """Untrained, but with BatchNorm scales of both signs and statistics that fit, so that its predictions depend on what it sees."""
    torch.manual_seed(int(rng.integers(2 ** 31)))
    net = network(config)
    for norm in norms_of(net):
        norm.weight.data, norm.bias.data = torch.randn_like(norm.weight), torch.randn_like(norm.bias)
    update_bn([a_batch(rng, config)], net)
    return net.eval()


def predict(net, p, q):
    return to_vector(d3dlo.predict_motions(net, np.stack([scan_geometry(s, net.config) for s in (p, q)])))[0]


# ------------------------------------------------------------------------------------------------- sampling and grouping

KINDS = st.sampled_from(["grid", "duplicates", "line", "float32", "float64"])


def points(rng, kind, N):
    if kind == "grid":                                  # full of ties, and exact in floating point
        return rng.integers(-4, 5, (N, 3)).astype(np.float32)
    if kind == "duplicates":
        return rng.normal(size=(max(N // 3, 1), 3)).astype(np.float32)[rng.integers(max(N // 3, 1), size=N)]
    if kind == "line":
        return np.outer(rng.normal(size=N), [1, 0, 0]).astype(np.float32)
    return (rng.normal(size=(N, 3)) * [20, 20, 2]).astype(kind)


def fps_by_definition(xyz, n, start=0):
    """From the matrix of all distances: each pick has the largest distance to the nearest pick before it."""
    x, y, z = ((c[:, None] - c) ** 2 for c in xyz.T)
    D, picks = x + y + z, [start]
    for _ in range(n - 1):
        picks.append(int(D[picks].min(0).argmax()))     # the first of equals
    return np.array(picks)


@given(SEED, KINDS, st.integers(1, 60))
def test_the_textbook_fps_follows_the_definition(seed, kind, N):
    xyz, start = points(generator(seed), kind, N), seed % N
    assert_array_equal(fps_textbook(xyz, N, start), fps_by_definition(xyz, N, start))


@given(SEED, KINDS, st.sampled_from([1, 2, 3, 191, 192, 193, 385]) | st.integers(1, 1500), st.sampled_from([20, 60, 1500]))
@settings(max_examples=150)
def test_the_fast_fps_equals_the_textbook_loop_to_the_index(seed, kind, N, n):
    xyz, n, start = points(generator(seed), kind, N), min(n, N), seed % N
    assert_array_equal(farthest_point_sampling(xyz, n, start), fps_textbook(xyz, n, start))


@pytest.mark.parametrize("N, n", [(5, 6), (5, 0), (0, 1), (1023, 1024)])
def test_fps_refuses_more_samples_than_points(N, n):
    with pytest.raises(ValueError, match=f"{n} .*{N}"):
        farthest_point_sampling(np.zeros((N, 3), np.float32), n)


@given(SEED, KINDS, st.integers(1, 300), st.integers(1, 12), st.sampled_from([0.5, 1.0, 2.0, 5.0]))
@settings(max_examples=50)
def test_group_ball_equals_brute_force(seed, kind, N, n_n, r):
    rng = generator(seed)
    xyz, centroids = points(rng, kind, N), rng.integers(N, size=20)
    D = cdist(xyz[centroids].astype(float), xyz.astype(float))
    for c, d, row in zip(centroids, D, group_ball(xyz, centroids, r, n_n), strict=True):
        near = np.sort(d[d <= r])[:n_n]                 # on the grid distances of exactly r occur
        m = len(near)
        assert_allclose(d[row[:m]], near, rtol=1e-6, atol=1e-6)         # nearest first
        assert len(set(row[:m])) == m and d[row].min() == 0 and len(row) == n_n
        assert_array_equal(row[m:], c)                  # missing neighbours


@pytest.mark.parametrize("r", [0.1, 0.3, 1.0, 4.0, 8.0])
def test_the_radius_of_a_ball_is_inclusive(r):
    beyond = np.nextafter(np.nextafter(r, np.inf), np.inf)
    assert_array_equal(group_ball(np.array([[0, 0, 0], [r, 0, 0], [0, beyond, 0]]), np.array([0]), r, 3), [[0, 1, 0]])


@given(SEED, KINDS, st.integers(1, 12) | st.integers(1, 300), st.integers(1, 16))
def test_group_knn_equals_brute_force(seed, kind, N, k):
    rng = generator(seed)
    xyz, query = points(rng, kind, N), points(rng, kind, 20)
    D = cdist(query.astype(float), xyz.astype(float))
    for d, row in zip(D, group_knn(xyz, query, k), strict=True):
        assert_allclose(d[row[:N]], np.sort(d)[:k], rtol=1e-12, atol=1e-12)
        assert len(set(row[:N])) == min(k, N) and len(row) == k
        assert_array_equal(row[N:], row[0])             # fewer than k points: the nearest once more


@given(SEED, KINDS, st.integers(1, 60), st.integers(1, 70))
def test_neighbours_by_a_matrix_are_those_of_the_tree(seed, kind, N, k):
    rng = generator(seed)
    clouds = [(points(rng, kind, N), points(rng, kind, 20)) for _ in range(2)]
    xyz, query = (torch.from_numpy(np.stack(part)) for part in zip(*clouds))
    for (y, x), rows in zip(clouds, d3dlo.knn_by_matrix(query, xyz, k), strict=True):
        D = cdist(x.astype(float), y.astype(float))
        expected = np.take_along_axis(D, group_knn(y, x, k), 1)
        got = np.take_along_axis(D, rows.numpy(), 1)
        assert_allclose(got, expected, atol=1e-4)
        assert all(len(set(row.tolist())) == min(k, N) for row in rows)
        assert (rows[:, N:] == rows[:, :1]).all() and rows.shape == (20, k)


@given(SEED)
def test_scan_geometry_is_fps_and_grouping_of_the_usable_points(seed):
    rng = generator(seed)
    usable = cloud(rng, 200)
    junk = np.float32([[np.nan, 0, 0, 0], [0, np.inf, 0, 0], [1, 1, 1, np.nan], [0, 50.1, 0, 0], [1e30, 0, 0, 0]])
    g, xyz = scan_geometry(np.insert(usable, rng.integers(1, 200, len(junk)), junk, axis=0), SMALL), usable[:, :3]
    picks = fps_textbook(xyz, 32)
    neighbours = usable[group_ball(xyz, picks, 2.0, 4)]
    assert g["broken"] == 4                             # far away is not broken
    assert_array_equal(g["xyz"], xyz[picks])
    assert_array_equal(g["group_sa1"], np.concatenate([neighbours[..., 3:], neighbours[..., :3] - xyz[picks][:, None]], -1))
    assert_array_equal(g["idx_sa2"], group_ball(xyz[picks], np.arange(16), 4.0, 8))
    assert_array_equal(g["idx_sa3"], group_ball(xyz[picks[:16]], np.arange(8), 8.0, 4))
    fullest = max(((xyz[:, 2] >= z) & (xyz[:, 2] < z + 0.3)).sum() for z in np.arange(-10, 10) * 0.3)
    assert_allclose(g["stats"], [200, usable[:, 3].mean(), np.median(np.sqrt(np.square(g["xyz"]).sum(1))), fullest / 200], rtol=0.02)


# --------------------------------------------------------------------------------------------------------------- motions

def by_hand(v):
    (cr, cp, cy), (sr, sp, sy) = np.cos(np.radians(v[3:])), np.sin(np.radians(v[3:]))
    Rx, Ry, Rz = [[1, 0, 0], [0, cr, -sr], [0, sr, cr]], [[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]], [[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]]
    return np.block([[np.array(Rz) @ Ry @ Rx, np.reshape(v[:3], (3, 1))], [np.array([0, 0, 0, 1])]])


@given(SEED, st.lists(st.integers(0, 5), max_size=3))
@settings(max_examples=100)
def test_vectors_are_extrinsic_xyz_of_any_leading_shape_and_survive_the_round_trip(seed, shape):
    v = generator(seed).uniform(-1, 1, (*shape, 6)) * [100, 100, 100, 179.9, 89, 179.9]
    T = from_vector(v)
    assert_allclose(T, np.reshape([by_hand(row) for row in v.reshape(-1, 6)], (*shape, 4, 4)), atol=1e-12)
    assert_allclose(to_vector(T), v, atol=1e-7)
    assert_allclose(invert(T), np.linalg.inv(T), atol=1e-11)


@given(SEED, st.sampled_from([90, -90]), st.sampled_from([0, 1e-12, 1e-9, 1e-7, 1e-5, 1e-3, 0.1]))
@settings(max_examples=150)
def test_motions_survive_the_round_trip_at_gimbal_lock_without_a_warning(seed, pole, off):
    roll, yaw = generator(seed).uniform(-179.9, 179.9, 2)
    T = by_hand(np.array([1, 2, 3, roll, pole - np.sign(pole) * off, yaw]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert_allclose(from_vector(to_vector(T)), T, atol=1e-6)


@given(SEED)
def test_camera_and_velodyne_frames_tell_the_same_story(seed):
    rng = generator(seed)
    T, Tr, q = motion(rng, [5, 5, 5, 60, 60, 60], n=7), motion(rng, [1, 1, 1, 90, 60, 90]), rng.normal(size=(10, 3))
    T_cam = kitti.velo_to_camera(T, Tr)
    assert_allclose(kitti.camera_to_velo(T_cam, Tr), T, atol=1e-12)
    for velo, cam in zip(T, T_cam):                     # look from the camera, then move; or move, then look from the camera
        assert_allclose(move(cam, move(Tr, q)), move(Tr, move(velo, q)), atol=1e-12)


# --------------------------------------------------------------------------------------------------------------- network

def count(module):
    return sum(p.numel() for p in module.parameters() if p.requires_grad)


def test_table_1_has_61290_parameters():
    blocks = {"sa1": 868, "fe": 4480, "sa2": 8768, "sa3": 8768, "mpn": 21440, "mlp": 16966}
    assert {name: count(block) for name, block in D3DLO().named_children()} == blocks and count(D3DLO()) == 61290


def test_the_default_config_is_the_papers():
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
    """Fails for every operation that returns a tensor on another device."""

    def __torch_dispatch__(self, function, types, arguments=(), options=None):
        result = function(*arguments, **options or {})
        for tensor in torch.utils._pytree.tree_leaves(result):
            assert not isinstance(tensor, torch.Tensor) or tensor.is_meta, function
        return result


@pytest.mark.parametrize("training", [True, False])
def test_the_network_makes_no_tensor_on_the_cpu(training):
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
    "small": SMALL, "one neighbour": replace(SMALL, sa1=SMALL.sa1._replace(n_n=1), fe=SMALL.fe._replace(n_n=1), sa2=SMALL.sa2._replace(n_n=1)),
    "centroids alone": replace(SMALL, swap="random", sa3=SMALL.sa3._replace(r=0.1)),         # every neighbour is the same: ties
    "more neighbours than points": replace(SMALL, fe=SMALL.fe._replace(n_n=40), sa3=SMALL.sa3._replace(n_n=20))}


@table("config", CONFIGS)
@pytest.mark.parametrize("training", [True, False])
@given(seed=SEED)
def test_the_fast_network_equals_the_plain_one(training, config, seed):
    rng = generator(seed)
    net = a_net(rng, config).double()
    plain, fast = copy.deepcopy(net).train(training), d3dlo.fast(net).train(training)
    batch = in_double(a_batch(rng, config)[0])
    expected, got = plain(batch), fast(batch)
    torch.testing.assert_close(got, expected, rtol=1e-9, atol=1e-9)
    assert got.std(0).min() > 1e-3                      # the predictions differ from pair to pair, so there was something to compare
    weights = torch.from_numpy(rng.normal(size=expected.shape))
    names, parameters = zip(*net.named_parameters())    # the twin has no parameters of its own
    got, expected = (torch.autograd.grad((y * weights).sum(), p) for y, p in ((got, parameters), (expected, [*plain.parameters()])))
    for name, a, b in zip(names, got, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-6, atol=1e-8, msg=lambda m: f"{name}: {m}")
    for (name, a), b in zip(net.state_dict().items(), plain.state_dict().values(), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-9, msg=lambda m: f"{name}: {m}")       # running statistics too
    assert {type(m) for m in fast.modules()} & {type(m) for m in plain.modules()} == {
        D3DLO, torch.nn.Sequential, torch.nn.Linear, torch.nn.BatchNorm1d, torch.nn.ReLU}


def by_the_equations(net, b):
    """Eqs. 3 and 4 point by point: for every centroid a loop over its neighbours, h in eval mode, and the maximum."""
    def h(mpn, *parts):
        return mpn.h(torch.cat(parts)[None])[0]

    def eq_3(sa, x, f, idx):
        return x[:len(idx)], torch.stack([torch.stack([h(sa.mpn, f[i], x[i] - x[j]) for i in near]).max(0).values
                                          for j, near in enumerate(idx)])
    out = []
    for p, q in zip(b.p, b.q):
        f, g = (torch.stack([torch.stack([h(net.sa1.mpn, point) for point in ball]).max(0).values for ball in b.group_sa1[c]]) for c in (p, q))
        x, y = b.xyz[p], b.xyz[q]
        nearest = torch.cdist(x, y, compute_mode="donot_use_mm_for_euclid_dist").topk(net.config.fe.n_n, largest=False).indices
        e = torch.stack([torch.stack([h(net.fe.mpn, f[i], g[j], y[j] - x[i]) for j in near]).max(0).values for i, near in enumerate(nearest)])
        x, e = eq_3(net.sa2, x, e, b.idx_sa2[p])
        x, e = eq_3(net.sa3, x, e, b.idx_sa3[p])
        out.append(net.mlp(torch.stack([h(net.mpn, e_i) for e_i in e]).max(0).values[None])[0])
    return torch.stack(out)


@given(seed=SEED)
@settings(max_examples=5)
def test_the_plain_network_is_equations_3_and_4(seed):
    rng = generator(seed)
    net, batch = a_net(rng).double(), in_double(a_batch(rng, pairs=1)[0])
    torch.testing.assert_close(net(batch), by_the_equations(net, batch), rtol=1e-9, atol=1e-9)


@given(SEED, st.booleans())
def test_the_maximum_shares_its_gradient_among_equals_as_amax_does(seed, moments):
    rng = generator(seed)
    h, W = (torch.from_numpy(rng.integers(-1, 2, s).astype(float)).requires_grad_() for s in ((2, 3, 6, 3), (4, 3)))    # exact: real ties
    fast, slow = d3dlo.LinearMax.apply(h, W, moments)[0], (h @ W.t()).amax(2)
    torch.testing.assert_close(fast, slow, rtol=0, atol=0)
    grad = torch.from_numpy(rng.normal(size=fast.shape))
    torch.testing.assert_close(*(torch.autograd.grad(y, (h, W), grad) for y in (fast, slow)))


@given(SEED)
def test_no_gradient_is_lost_when_the_product_is_rounded_differently_the_second_time(seed):
    rng = generator(seed)
    h, W = (torch.from_numpy(rng.normal(size=s)).requires_grad_() for s in ((2, 3, 6, 3), (4, 3)))
    out = d3dlo.LinearMax.apply(h, W, False)[0]
    with pytest.MonkeyPatch.context() as patch:         # the product of the backward pass is a little larger
        mm = torch.mm
        patch.setattr(torch, "mm", lambda a, b, out: mm(a, b, out=out).mul_(1 + 1e-12))
        grad_h, = torch.autograd.grad(out.sum(), h)
    expected, = torch.autograd.grad((h @ W.t()).amax(2).sum(), h)
    torch.testing.assert_close(grad_h, expected)


@pytest.mark.parametrize("momentum", [0.1, 0.0, 1.0, None])
def test_the_fast_network_updates_running_statistics_with_every_momentum(momentum):
    rng = generator(0)
    net = a_net(rng)
    for norm in norms_of(net):
        norm.momentum = momentum
    plain, fast, batch = copy.deepcopy(net).train(), d3dlo.fast(net).train(), a_batch(rng)[0]
    plain(batch), fast(batch)
    for (name, a), b in zip(net.state_dict().items(), plain.state_dict().values(), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5, msg=lambda m: f"{name}: {m}")


def test_recomputed_statistics_are_the_means_over_batches():
    rng = generator(0)
    net, batches = a_net(rng), [a_batch(rng) for _ in range(3)]
    statistics = []
    for batch, _ in batches:                            # of one batch alone
        alone = copy.deepcopy(net).train()
        for norm in norms_of(alone):
            norm.momentum = 1
        alone(batch)
        statistics.append([(norm.running_mean, norm.running_var) for norm in norms_of(alone)])
    update_bn(iter(batches), d3dlo.fast(net))           # (Batch, poses) pairs, as `fit` has them
    for norm, of_batches in zip(norms_of(net), zip(*statistics), strict=True):
        mean, var = (torch.stack(part).mean(0) for part in zip(*of_batches))
        torch.testing.assert_close((norm.running_mean, norm.running_var), (mean, var), rtol=1e-3, atol=1e-4)


@given(SEED)
def test_the_loss_is_equation_2(seed):
    y, y_hat = (torch.from_numpy(generator(seed + i).normal(size=(4, 6))) for i in range(2))
    torch.testing.assert_close(d3dlo.UnweightedLoss()(y_hat, y), F.l1_loss(y_hat, y))


# -------------------------------------------------------------------------------------------------------------- training

@pytest.mark.parametrize("frozen", [0, 0.25])
def test_sixteen_pairs_can_be_learned_by_heart(tmp_path, frozen):
    geometry, motions = pairs_of_scans(generator(0), 16)
    config, said = replace(SMALL, epochs=300, lr=1e-2, schedule="one-cycle", frozen=frozen), []
    torch.manual_seed(0)
    net = d3dlo.fit(D3DLO(config), geometry, motions, tmp_path, say=said.append, **FACTS)
    before, in_training, in_use = (float(re.search(r"[\d.]{6}", said[i])[0]) for i in (0, -2, -1))
    assert before > 0.3 and in_training < 0.02 and in_use < 0.02  # eq. 2, m and degrees alike
    got = to_vector(np.concatenate([d3dlo.predict_motions(net, records) for records in geometry]))
    assert np.abs(got - to_vector(np.concatenate(motions))).mean() < 0.02  # as odometry predicts


@given(SEED, st.sampled_from(["both", "random"]), st.booleans(), st.integers(2, 12))
def test_batches_depend_on_seed_and_step_alone(seed, swap, augmented, batch):
    config, (geometry, motions) = replace(SMALL, swap=swap, augment=augmented, batch=batch), drives()
    steps = 2 * d3dlo.steps_per_epoch(motions, config)

    def made(seed, start, stop):
        return [b"".join(np.asarray(part).tobytes() for part in (*batch, T))
                for batch, T in d3dlo.batches(geometry, motions, config, (seed,), start, stop)]
    whole = made(seed, 0, steps)                        # two epochs
    assert all(made(seed, k, steps) == whole[k:] for k in (0, 1, steps // 2, steps - 1))
    assert made(seed + 1, 0, 1) != whole[:1]
    two = d3dlo.batches([geometry[0][:3]], [motions[0][:2]], config, (seed,), 0, 2)             # two epochs of two pairs: drawn anew
    assert not augmented or len({T.tobytes() for _, T in two}) == 2


@given(SEED, st.sampled_from(["both", "random"]), st.integers(2, 12))
def test_an_epoch_holds_every_pair_once_with_the_motion_of_its_direction(seed, swap, batch):
    config, (geometry, motions) = replace(SMALL, swap=swap, batch=batch), drives()
    name, seen = {g["xyz"].tobytes(): (s, i) for s, records in enumerate(geometry) for i, g in enumerate(records)}, []
    for b, T_pq in d3dlo.batches(geometry, motions, config, (seed,), 0, d3dlo.steps_per_epoch(motions, config)):
        assert len(T_pq) >= min(batch, 10)              # no small batch is left over
        for p, q, T in zip(b.p, b.q, T_pq, strict=True):
            (s, i), (s_, j) = (name[b.xyz[c].numpy().tobytes()] for c in (p, q))
            expected = motions[s][min(i, j)]
            assert s == s_ and abs(i - j) == 1
            assert_allclose(T, expected if i < j else np.linalg.inv(expected), atol=1e-9)
            seen.append((s, min(i, j), i < j))
        assert swap != "both" or 2 * len({pair[:2] for pair in seen}) == len(seen)        # both directions in one batch
    assert sorted({pair[:2] for pair in seen}) == [(s, i) for s in range(2) for i in range(5)]
    assert len(seen) == len(set(seen)) == (20 if swap == "both" else 10)
    assert swap == "random" or {forward for *_, forward in seen} == {True, False}


def test_the_direction_of_a_pair_is_random():
    (geometry, motions), config = drives(), replace(SMALL, swap="random", batch=10)
    first = [(b.p[0] < b.q[0]).item() for b, _ in d3dlo.batches(geometry, motions, config, (0,), 0, 40)]
    assert 8 < sum(first) < 32                          # 20 are expected, with a standard deviation of 3


@pytest.mark.parametrize("batch, pairs", [(1, 10), (16, 1)])
def test_batches_of_one_directed_pair_are_refused(batch, pairs):
    with pytest.raises(ValueError, match="at least 2"):
        d3dlo.steps_per_epoch([np.zeros((pairs, 4, 4))], replace(SMALL, swap="random", batch=batch))


@given(SEED)
def test_augmented_pairs_still_fit_their_motion(seed):
    rng = generator(seed)
    geometry, motions = pairs_of_scans(rng, 6, points=200, config=SMALL)
    for p, q in geometry:  # Q is P moved: the same points in the same order
        assert_array_equal(p["idx_sa2"], q["idx_sa2"])
    before, T = np.stack([g[d] for d in (0, 1) for g in geometry]), np.concatenate(motions)
    clouds, T_new = d3dlo.augment(before, T, rng)
    for p, q, old, X, Y in zip(clouds[:6], clouds[6:], before[:6], T_new, T):
        assert_allclose(move(X, q["xyz"]), p["xyz"], atol=1e-4)
        near_p, near_q = (c["xyz"][:, None] + c["group_sa1"][..., 1:] for c in (p, q))
        assert_allclose(move(X, near_q), near_p, atol=1e-4)
        assert np.linalg.det(X[:3, :3]) > 0.999  # no reflection is left
        assert np.abs(X - Y).max() > 1e-3  # something moved
        left_to_right = np.sign(p["xyz"][0, 1] * old["xyz"][0, 1])
        assert_array_equal(p["xyz"] * [1, left_to_right, 1], old["xyz"])
    before["xyz"], before["group_sa1"][..., 1:] = clouds["xyz"], clouds["group_sa1"][..., 1:]
    assert before.tobytes() == clouds.tobytes()         # nothing else has changed


def test_augmentation_mirrors_left_and_right_and_aligns_a_quarter_of_the_pairs():
    n, rng = 2000, generator(0)
    far = by_hand(np.array([100, 40, 0, 0, 0, 90.0]))  # a residual motion is not as large
    scans = np.zeros(2 * n, d3dlo.geometry_dtype(replace(SMALL, sa1=SMALL.sa1._replace(n_fps=16))))
    scans["xyz"][:] = 1
    moved, T = d3dlo.augment(scans, np.tile(far, (n, 1, 1)), rng)
    p = moved["xyz"][:n, 0]
    assert_array_equal(np.unique(p, axis=0), [[1, -1, 1], [1, 1, 1]])  # y is left, in a half
    mirrored = p[:, 1] < 0
    assert abs(mirrored.mean() - 0.5) < 0.05
    aligned = np.linalg.norm(T[:, :3, 3], axis=1) < 3
    assert abs(aligned.mean() - 0.25) < 0.05
    mirror = np.diag([1, -1, 1, 1])
    for chosen, base in ((aligned, np.eye(4)), (~aligned & mirrored, mirror @ far @ mirror),
                         (~aligned & ~mirrored, far)):
        A = to_vector(invert(T[chosen]) @ base)  # Q moves after it has been aligned
        assert_allclose(A.mean(0), 0, atol=0.15)
        assert_allclose(A.std(0), [0.25, 0.1, 0.03, 0.1, 0.1, 1.0], rtol=0.15)


def fit(folder, config, resume=None, test=None, say=None):
    """Train on `drives()` until the end or an interruption. Returns the lines said."""
    said = []
    torch.manual_seed(0 if resume is None else 99)  # a resumed net must not depend on its start
    with contextlib.suppress(KeyboardInterrupt, BrokenPipeError):
        d3dlo.fit(D3DLO(config), *drives(), folder, 7, "cpu", resume, say or said.append,
                  test=test, **FACTS)
    return said


def stored(folder, name="weights.pt"):
    return torch.load(folder / name, weights_only=True)


def assert_same_model(a, b):
    """Of two weights files or checkpoints, to the bit."""
    assert a["step"] == b["step"] and a["model"].keys() == b["model"].keys()
    assert all(torch.equal(tensor, b["model"][name]) for name, tensor in a["model"].items())


@pytest.mark.parametrize("stop, stored, schedule, optimizer, frozen", [     # of 15 steps, in the middle of the eighth and of an epoch
    (None, 7, "steps", "adam", 0), (None, 7, "one-cycle", "muon", 8 / 15),  # at once: there is only what was stored before
    (signal.SIGINT, 8, "steps", "adam", 7 / 15), (signal.SIGTERM, 8, "one-cycle", "muon", 0.6)])
def test_a_training_goes_on_as_if_never_stopped_and_a_finished_one_stays(tmp_path, monkeypatch, stop, stored, schedule, optimizer, frozen):
    config = replace(SMALL, epochs=5, batch=3, schedule=schedule, optimizer=optimizer, augment=True, frozen=frozen)
    steps, loss_of = [], d3dlo.UnweightedLoss.forward

    def loss_with_a_stop(*arguments):
        steps.append(1)
        if len(steps) == 8 and not stop:
            raise KeyboardInterrupt
        if len(steps) == 8:
            os.kill(os.getpid(), stop)
        return loss_of(*arguments)

    def load(folder, name):
        return torch.load(tmp_path / folder / name, weights_only=True)
    whole, handlers = fit(tmp_path / "whole", config), [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    monkeypatch.setattr(d3dlo.UnweightedLoss, "forward", loss_with_a_stop)
    monkeypatch.setattr(d3dlo, "STORE_EVERY", 0)        # a checkpoint after each step
    part = fit(tmp_path / "part", config)
    monkeypatch.undo()
    assert len(steps) == 8 and load("part", "checkpoint.pt")["step"] == stored
    assert handlers == [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    for said in (part, whole[:-1]):                     # stopped; finished
        assert said + fit(tmp_path / "part", config, load("part", "checkpoint.pt")) == whole
        for name in ("checkpoint.pt", "weights.pt"):
            a, b = load("whole", name), load("part", name)
            assert a["step"] == b["step"] == 15 and all(torch.equal(tensor, b["model"][key]) for key, tensor in a["model"].items())


@table("ends_with", {"the reader of stdout has gone": BrokenPipeError, "a bug": ZeroDivisionError})
def test_whatever_ends_a_training_run_between_two_steps_it_leaves_a_checkpoint(tmp_path, ends_with):
    config = replace(SMALL, epochs=4, batch=3, augment=True)

    def say(line):
        part.append(line)
        if "epoch 2" in line:
            raise ends_with
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
@pytest.mark.parametrize("epochs, batch", [(50, 3), (1, 10)])  # (1, 10): in the last step
def test_a_training_run_that_diverges_says_so_and_stores_no_nan(tmp_path, tested, epochs, batch):
    config = replace(SMALL, epochs=epochs, batch=batch, lr=1e30)
    with pytest.raises(ValueError, match=r"not finite at step [1-9], learning rate 1\.0e\+"):
        fit(tmp_path, config, test=drives() if tested else None)
    assert not any(tmp_path.iterdir())


def test_learning_rates_drop_to_a_tenth_at_epochs_300_and_400_of_500(tmp_path):
    optimizer, rates = torch.optim.SGD([torch.zeros(1)]), []
    optimizer.param_groups[0]["lr"] = 1.0
    scheduler = d3dlo.make_scheduler(optimizer, Config(), 500 * 2)  # 2 steps an epoch
    for _ in range(500 * 2):
        rates.append(scheduler.get_last_lr()[0])
        optimizer.step()
        scheduler.step()
    assert_allclose(rates, [1.0] * 600 + [0.1] * 200 + [0.01] * 200)
    said = fit(tmp_path, replace(SMALL, epochs=10, batch=5, lr=0.002))
    rates = re.findall(r"learning rate (\S+)", "\n".join(said))
    assert rates == ["2.0e-03"] * 6 + ["2.0e-04"] * 2 + ["2.0e-05"] * 2


@pytest.mark.parametrize("frozen", [0, 0.5])
def test_statistics_are_recomputed_at_the_end_unless_they_were_fixed(tmp_path, frozen):
    geometry, motions = drives()  # all 10 pairs in each batch: all have the same statistics
    config = replace(SMALL, epochs=6, batch=10, lr=1e-2, frozen=frozen)
    fit(tmp_path, config)
    weights, checkpoint = (stored(tmp_path, f"{name}.pt")["model"]
                           for name in ("weights", "checkpoint"))
    if frozen:  # trained with these statistics
        assert all(torch.equal(tensor, checkpoint[name]) for name, tensor in weights.items())
        return
    net = D3DLO(config).train()
    net.load_state_dict(weights)
    for norm in norms_of(net):
        norm.momentum = 1  # the statistics of the one batch
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
    assert all(map(torch.equal, matrices, before))  # without weight decay
    for W in matrices:
        W.grad = torch.randn_like(W)
    muon.step()
    for W, old in zip(matrices, before):
        size = (W - old).square().mean().sqrt() / net.config.lr
        assert 0.1 < size < 0.3  # 0.2, as Adam's steps have (Liu et al., "Muon is scalable")


TEST_LOSS = re.compile(r", test loss (\d+\.\d{4})")


@table("config", {
    "short": replace(SMALL, epochs=4, batch=3, augment=True, optimizer="muon",
                     schedule="one-cycle", frozen=0.25),
    "the paper's": replace(SMALL, epochs=4, batch=3, swap="random")})
def test_the_test_loss_changes_nothing_and_is_logged_once_an_epoch(tmp_path, config):
    test = pairs_of_scans(generator(1), 9)
    alone, whole = fit(tmp_path / "alone", config), fit(tmp_path / "whole", config, test=test)
    for name in ("weights.pt", "checkpoint.pt"):
        assert_same_model(stored(tmp_path / "alone", name), stored(tmp_path / "whole", name))
    assert [TEST_LOSS.sub("", line) for line in whole] == alone
    assert [len(TEST_LOSS.findall(line)) for line in whole] == [1] * 4 + [0]

    # The last one is that of the weights in the file, over both directions of all pairs.
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
def test_the_test_loss_is_over_at_most_500_fixed_pairs_of_all_sequences(n, m):
    def pairs(net):  # every scan is known by its number
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(d3dlo, "training_batch", lambda *arguments: (arguments[2], None))
            parts = d3dlo.held_out_examples(None, [range(n), range(m)], SMALL, "cpu")
            return [pair for part, _ in parts for pair in part]
    chosen = pairs(0)
    everything = [(0, i) for i in range(n)] + [(1, i) for i in range(m)]
    assert len(chosen) == len(set(chosen)) == min(500, n + m) and chosen == pairs(1)
    gaps = np.diff([everything.index(pair) for pair in chosen])
    assert chosen[0] == (0, 0) and chosen[-1] == (1, m - 1)
    assert n + m == 1 or len(set(gaps)) <= 2  # evenly spread


# --------------------------------------------------------------------------------------------------------------- metrics

def devkit(T_gt, T_est):
    """KITTI's trajectoryDistances, lastFrameFromSegmentLength and calcSequenceErrors, loop by loop."""
    dist, errors = [0.0], []
    for a, b in zip(T_gt, T_gt[1:]):
        dx, dy, dz = a[:3, 3] - b[:3, 3]
        dist.append(dist[-1] + math.sqrt(dx * dx + dy * dy + dz * dz))
    for first in range(0, len(T_gt), 10):
        for length in (100, 200, 300, 400, 500, 600, 700, 800):
            last = -1
            for i in range(first, len(T_gt)):
                if dist[i] > dist[first] + length:
                    last = i
                    break
            if last == -1:
                continue
            delta_gt, delta_est = np.linalg.inv(T_gt[first]) @ T_gt[last], np.linalg.inv(T_est[first]) @ T_est[last]
            error = np.linalg.inv(delta_est) @ delta_gt
            d = 0.5 * (error[0, 0] + error[1, 1] + error[2, 2] - 1.0)
            r, t = math.acos(max(min(d, 1.0), -1.0)), math.sqrt(error[0, 3] ** 2 + error[1, 3] ** 2 + error[2, 3] ** 2)
            errors.append((first, last, length, 100 * t / length, math.degrees(r) / length))
    return np.array(errors).reshape(-1, 5)


def straight(n, step=1.0):
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, 2, 3] = step * np.arange(n)                    # the camera looks along z
    return T


DRIVES = {"winding": trajectory, "straight": lambda rng, n: straight(n, 2.5)}       # on a straight one 100 m end in a frame
DRIVES |= {f"real {file.stem}": lambda rng, n, T=metrics.read_poses(file): T[:n] for file in sorted(KITTI.glob("poses/*.txt"))[:2]}


@table("drive", DRIVES)
@given(seed=SEED, n=st.integers(2, 450), size=st.sampled_from([0, 1e-5, 0.02, 20]))
def test_errors_of_segments_are_the_devkits_and_those_of_steps_what_was_put_in(drive, seed, n, size):
    rng = generator(seed)
    T_gt = drive(rng, n)
    E, start = motion(rng, size, len(T_gt) - 1), motion(rng, [50, 50, 50, 90, 60, 90])          # where the estimate starts does not matter
    T_est = start @ d3dlo.accumulate(np.linalg.inv(T_gt[:-1]) @ T_gt[1:] @ E)
    expected, got = devkit(T_gt, T_est), metrics.segment_errors(T_gt, T_est)
    for field, column, tolerance in zip(("first", "last", "length", "t_err", "r_err"), expected.T, (0, 0, 0, 1e-7, 1e-6)):
        assert_allclose(got[field], column, rtol=tolerance, atol=tolerance)
    angle = np.degrees(Rotation.from_matrix(E[:, :3, :3]).magnitude())
    assert_allclose(metrics.step_errors(T_gt, T_est), np.stack([np.linalg.norm(E[:, :3, 3], axis=1), angle], 1), atol=1e-9)


@pytest.mark.parametrize("error", [metrics.segment_errors, metrics.step_errors, metrics.absolute_errors])
def test_errors_refuse_lengths_that_differ(error):
    with pytest.raises(ValueError, match="20.*19"):
        error(straight(20), straight(19))


@given(SEED)
def test_absolute_errors_are_distances_in_space_and_rmse_the_root_of_the_mean_square(seed):
    rng = generator(seed)
    T = trajectory(rng, 20)
    apart = rng.normal(size=(20, 3)) * [1, 2, 4]
    moved = T.copy()
    moved[:, :3, 3] += apart
    errors = metrics.absolute_errors(T, moved)
    assert_allclose(errors, [math.hypot(*xyz) for xyz in apart], atol=1e-9)
    assert metrics.rmse(errors) ** 2 == pytest.approx(errors.var() + errors.mean() ** 2)


@given(SEED, st.integers(1, 30))
def test_pose_files_survive_the_round_trip(tmp_path, seed, n):
    T, path = trajectory(generator(seed), n), tmp_path / "new" / "a.txt"
    metrics.write_poses(path, T)
    assert_allclose(metrics.read_poses(path), T, rtol=1e-8, atol=1e-8)
    assert os.listdir(path.parent) == ["a.txt"] and np.loadtxt(path, ndmin=2).shape == (n, 12)


@given(SEED, st.sampled_from([0, 1e-9, 1e-4, 1, 179.9999, 180]))
def test_tum_files_hold_times_positions_and_unit_quaternions(tmp_path, seed, degrees):
    rng = generator(seed)
    axes = np.r_[rng.normal(size=(4, 3)), np.eye(3), -np.eye(3)]    # also x, y and z
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    T = motion(rng, n=len(axes))
    T[:, :3, :3] = Rotation.from_rotvec(np.radians(degrees) * axes).as_matrix()
    times = 1.3e9 + np.cumsum(rng.uniform(0.05, 0.2, len(T)))    # seconds since 1970
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
def test_a_path_from_above_is_the_same_in_the_camera_s_and_the_lidar_s_frame(seed, gear):
    rng = generator(seed)
    signs = [gear, *rng.choice([-1, 1], 5)]             # forwards or in reverse
    steps = np.abs(rng.normal(size=(50, 6))) * [1, 0.05, 0.05, 1, 1, 6] * signs
    lidar = d3dlo.accumulate(from_vector(steps))
    Tr = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])   # in the same place
    camera = kitti.velo_to_camera(lidar, Tr)
    for T, labels in ((lidar, ["LiDAR -y, right [m]", "LiDAR x, forward [m]"]),
                      (camera, ["camera x, right [m]", "camera z, forward [m]"])):
        view, *named = metrics.view_from_above(T)
        assert named == labels
        assert_allclose(view @ T[:, :3, 3].T, [-lidar[:, 1, 3], lidar[:, 0, 3]], atol=1e-9)


# ------------------------------------------------------------------------------------------------------------------ data

@given(SEED, st.floats(-8, 8), st.floats(-8, 8))
def test_remove_plane_takes_the_ground_and_leaves_the_box(seed, roll, pitch):
    rng = generator(seed)
    ground = np.c_[rng.uniform(-20, 20, (3000, 2)), rng.normal(0, 0.02, 3000), rng.random(3000)]
    box = np.c_[rng.uniform(-8, 8, (1500, 2)), rng.uniform(0.4, 3, 1500), rng.random(1500)]
    scan, order = moved_scan(by_hand(np.array([0, 0, -1.7, roll, pitch, 0])), np.r_[ground, box]), rng.permutation(4502)
    scan = np.r_[scan, np.full((2, 4), np.nan, np.float32)][order]
    left = scan[order >= 3000]                          # all of the ground goes, nothing else; the order stays, and NaN too
    assert_array_equal(kitti.remove_plane(scan, seed=seed), left)


def test_the_ground_is_what_lies_within_15_cm_of_the_plane():
    rng = generator(0)
    ground = np.c_[rng.uniform(-20, 20, (3000, 2)), np.zeros(3000), rng.random(3000)]
    heights = np.array([-0.17, -0.13, 0.13, 0.17])
    near = np.c_[rng.uniform(-20, 20, (40, 2)), np.repeat(heights, 10), rng.random(40)]
    left = kitti.remove_plane(np.r_[ground, near].astype(np.float32))
    assert_array_equal(left, near[np.abs(near[:, 2]) > 0.15].astype(np.float32))


@pytest.mark.parametrize("plane", [True, False])
def test_without_the_plane_no_point_of_the_ground_is_sampled(plane):
    rng = generator(0)
    ground = np.c_[rng.uniform(-20, 20, (3000, 2)), np.full(3000, -1.7), rng.random(3000)]
    scan = np.r_[ground, cloud(rng, 500) + [0, 0, 3, 0]].astype(np.float32)
    record = scan_geometry(scan, replace(SMALL, plane=plane))
    assert (record["xyz"][:, 2].min() < -1.5) == plane
    assert record["stats"][0] == (3500 if plane else 500)


@pytest.mark.parametrize("N, thick", [(0, 0), (2, 0), (500, 0), (5000, 0.1)])
def test_remove_plane_without_a_plane_changes_nothing(N, thick):
    rng = generator(0)
    wall = np.c_[rng.normal(size=N) * thick, rng.uniform(-9, 9, N), rng.uniform(-2, 9, N), rng.random(N)].astype(np.float32)
    assert_array_equal(kitti.remove_plane(wall), wall)


def files_of(root):
    return {str(p.relative_to(root)): p.read_bytes() for p in Path(root).rglob("*") if p.is_file()}


@pytest.fixture(scope="session")
def city(tmp_path_factory):
    """Two simulated sequences of 8 scans, one of the training and one of the validation split. Read only."""
    return kitti.simulate(tmp_path_factory.mktemp("city"), sequences=("00", "07"), scans=8, azimuth=300, workers=1)


def test_the_simulation_gives_the_same_bytes_however_it_is_made_and_leaves_alone_what_is_there(city, tmp_path):
    def simulate(to, names, **more):
        return files_of(kitti.simulate(tmp_path / to, sequences=names, scans=8, azimuth=300, **more))
    made, other = files_of(city), simulate("other", ("07",), seed=1)
    assert simulate("two", ("07", "00"), workers=2) == made
    assert len(other) == 12 and all(data != made[name] for name, data in other.items() if name.endswith((".bin", "07.txt")))
    (tmp_path / "two" / SCAN).write_bytes(b"there")
    assert simulate("two", ("00", "07"))[SCAN] == b"there"


def test_simulated_scans_are_in_kittis_layout_and_fit_their_poses(tmp_path):
    s, = kitti.open_sequences(kitti.simulate(tmp_path, sequences=("00",), scans=3, azimuth=900, workers=1))
    assert len(s) == len(s.poses) == 3
    assert_allclose(s.poses[0], np.eye(4), atol=1e-8)
    assert np.abs(s.Tr[:3, :3] - np.eye(3)).max() > 0.9 and np.abs(s.Tr[:3, 3]).max() > 0.1         # a mistake of frames would show
    for scan in map(s.scan, range(3)):
        far = np.linalg.norm(scan[:, :3], axis=1)
        assert scan.dtype == np.float32 and len(scan) > 15000 and np.isfinite(scan).all() and 1 < far.min() and far.max() < 80.5
        assert 0 <= scan[:, 3].min() and scan[:, 3].max() <= 1
    for i, T in enumerate(s.motions()):
        p, q = s.scan(i)[:, :3], s.scan(i + 1)[:, :3]
        q, tree = q[q[:, 2] > -1.2], cKDTree(p)         # on the ground every motion along it fits
        right, *wrong = (np.median(tree.query(move(M, q))[0]) for M in (T, np.eye(4), invert(T), kitti.velo_to_camera(T, s.Tr)))
        assert right < 0.1 and min(wrong) > 3 * right


def test_simulated_test_drives_are_long_and_winding_enough_to_be_measured(tmp_path):
    errors, steps = [], []
    for s in kitti.open_sequences(kitti.simulate(tmp_path, sequences=["test"], azimuth=16, workers=1)):
        v = to_vector(s.motions())
        errors.append(metrics.segment_errors(s.poses, d3dlo.accumulate(from_vector(v * [1, 1, 1, 0, 0, 0]))))
        steps.append(v)
        assert metrics.path_lengths(s.poses)[-1] > 115 and len(errors[-1])
    steps = np.concatenate(steps)
    assert metrics.kitti_errors(errors)[0] > 40         # the true translation without rotation must not do well
    assert steps[:, 5].std() > 0.9 and 0.8 < np.linalg.norm(steps[:, :3], axis=1).mean() < 1.2


@pytest.mark.skipif(not KITTI.is_dir(), reason="D3DLO_KITTI names no folder")
def test_real_scans_are_sampled_exactly_and_lose_their_ground():
    for s in kitti.open_sequences(KITTI):
        scan = s.scan(len(s) // 2)
        assert_array_equal(farthest_point_sampling(scan[:, :3], 128), fps_textbook(scan[:, :3], 128))
        assert 0.25 < 1 - len(kitti.remove_plane(scan)) / len(scan) < 0.65


def write_root(root, names=("00",), scans=6, size=1100, step=1.0):
    """KITTI's layout with random scans, for whatever does not look at what is learned."""
    rng, Tr = generator(0), by_hand(np.array([0.1, -0.2, 0.3, -90, 0, -90]))
    for name in names:
        folder = root / "sequences" / name
        (folder / "velodyne").mkdir(parents=True)
        for i in range(scans):
            cloud(rng, size).tofile(folder / "velodyne" / f"{i:06d}.bin")
        (folder / "calib.txt").write_text(f"P0: 1 0 0 0 0 1 0 0 0 0 1 0\nTr: {' '.join(map(repr, Tr[:3].ravel().tolist()))}\n")
        metrics.write_poses(root / "poses" / f"{name}.txt", trajectory(rng, scans, np.array([step, 0.1, 0.1, 0.3, 0.3, 1])))
    return root


def write_folder(folder, scans=12, size=50, save=np.save, name="scan {}.npy", scale=1, columns=4):
    """A plain folder of random scans, numbered from 1 -> the scans."""
    rng = generator(0)
    folder.mkdir()
    factors = np.float32([1, 1, 1, scale])
    made = [(cloud(rng, size) * factors)[:, :columns] for _ in range(scans)]
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
    for i, scan in enumerate(scans):                    # 2 comes before 10
        assert s.scan(i).dtype == np.float32
        assert_array_equal(s.scan(i), scan)
    assert s.Tr is None and s.poses is None and s.poses_cam is None
    with pytest.raises(ValueError, match="drive has no ground truth"):
        s.motions()
    with pytest.raises(ValueError, match="'00'.*drive"):
        kitti.open_sequences(tmp_path / "drive", ["00"])


def test_times_of_a_folder_are_those_of_its_file_or_of_ten_scans_a_second(tmp_path):
    write_folder(tmp_path / "drive")
    s, = kitti.open_sequences(tmp_path / "drive")
    assert_allclose(s.times, np.arange(12) / 10)
    assert "10 scans a second" in " ".join(s.notes)
    times = 1.3e9 + np.arange(12) * 0.25
    np.savetxt(tmp_path / "drive" / "times.txt", times, fmt="%.6f")
    s, = kitti.open_sequences(tmp_path / "drive")
    assert_allclose(s.times, times, rtol=0, atol=1e-6)
    assert s.notes == []


@pytest.mark.parametrize("scale, columns, divisor, words", [
    (0.9, 4, 1, ""), (255, 4, 255, "255"), (2, 4, 255, "255"),
    (1, 3, 1, "no intensities"), (0, 4, 1, "no intensities")])
def test_intensities_of_a_folder_are_brought_to_0_to_1(tmp_path, scale, columns, divisor, words):
    scans = write_folder(tmp_path / "drive", scale=scale, columns=columns)
    (tmp_path / "drive" / "times.txt").write_text("\n".join(map(str, range(12))))
    s, = kitti.open_sequences(tmp_path / "drive")
    for i, scan in enumerate(scans):
        intensity = scan[:, 3] / np.float32(divisor) if columns == 4 else np.zeros(50)
        assert_array_equal(s.scan(i), np.c_[scan[:, :3], intensity])
    assert len(s.notes) == bool(words) and words in "".join(s.notes)


def test_ten_scans_spread_over_a_folder_decide_on_the_intensities_of_all(tmp_path):
    scans = write_folder(tmp_path / "drive", scans=37)
    looked_at = set(range(0, 37, 4))    # 10 of 37, the first and the last among them
    for bright in range(37):
        path = tmp_path / "drive" / f"scan {bright + 1}.npy"
        np.save(path, scans[bright] * np.float32([1, 1, 1, 200]))
        s, = kitti.open_sequences(tmp_path / "drive")
        assert s.intensity_max == (255 if bright in looked_at else 1)
        assert_array_equal(s.scan(5)[:, 3], np.load(s.scan_paths[5])[:, 3] / s.intensity_max)
        np.save(path, scans[bright])


def test_a_scan_cut_short_is_named_before_any_work_begins(tmp_path):
    write_folder(tmp_path / "drive", scans=37, save=save_bin, name="{}.bin")
    for i in range(1, 38):                              # not only those that are looked into
        whole = (tmp_path / "drive" / f"{i}.bin").read_bytes()
        (tmp_path / "drive" / f"{i}.bin").write_bytes(whole[:-1])
        with pytest.raises(ValueError, match=f"/{i}.bin has 799 bytes"):
            kitti.open_sequences(tmp_path / "drive")
        (tmp_path / "drive" / f"{i}.bin").write_bytes(whole)


def save_as(name, array):
    return lambda folder: np.save(folder / name, array, allow_pickle=True)


def write_as(name, text):
    return lambda folder: (folder / name).write_text(text)


def five_floats(points):
    """Scans as nuScenes': x, y, z, intensity up to 255 and the number of the beam."""
    def spoil(folder):
        for path in list(folder.iterdir()):
            scan = cloud(generator(1), points) * np.float32([1, 1, 1, 255])
            np.c_[scan, np.arange(points) % 32].astype(np.float32).tofile(path.with_suffix(".bin"))
            path.unlink()
    return spoil


class Mischief:
    def __reduce__(self):
        return os.mkdir, ("mischief",)


@table("spoil, words", {       # what is done to a good folder of scans; what the message must name
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
def test_a_folder_that_is_no_drive_is_refused_in_one_line(here, spoil, words):
    write_folder(here / "drive")
    spoil(here / "drive")
    before = files_of(here)
    with pytest.raises(ValueError) as refused:
        kitti.open_sequences(here / "drive")
    message = str(refused.value)
    assert all(word in message for word in words) and "\n" not in message, message
    assert files_of(here) == before and not (here / "mischief").exists()


def test_the_cache_holds_what_scan_geometry_says_and_is_made_anew_when_anything_changes(tmp_path):
    root, cache = write_root(tmp_path / "root", ("00", "drive"), size=60), tmp_path / "cache"

    def load(config=SMALL):
        sequences = kitti.open_sequences(root)
        geometry, fingerprints = load_geometry(sequences, config, cache)
        assert len(set(fingerprints)) == 2
        for s, records in zip(sequences, geometry, strict=True):
            assert [r.tobytes() for r in records] == [scan_geometry(s.scan(i), config).tobytes() for i in range(len(s))]
        return {p: p.stat().st_mtime_ns for p in cache.iterdir()}
    first, path = load(), root / "sequences" / "drive" / "velodyne" / "000002.bin"  # neither the first scan nor the last
    assert len(first) == 2 and load() == first          # nothing is made twice
    stamp = path.stat().st_mtime_ns + 10 ** 9
    cloud(generator(5), 60).tofile(path)                # of the same size
    os.utime(path, ns=(stamp, stamp))
    assert len(load()) == 3                             # one sequence changed
    for i, config in enumerate((
            replace(SMALL, sa1=Layer(1.0, *SMALL.sa1[1:])), replace(SMALL, sa1=Layer(2.0, 32, 5, (4, 8, 16))),
            replace(SMALL, sa2=Layer(4.0, 12, 8, (32, 32))), replace(SMALL, sa2=Layer(3.0, *SMALL.sa2[1:])),
            replace(SMALL, sa3=Layer(7.0, *SMALL.sa3[1:])), replace(SMALL, plane=False), replace(SMALL, max_range=9.0))):
        assert len(load(config)) == 5 + 2 * i
    alike = replace(SMALL, fe=Layer(None, None, 3, (16, 32)), lr=5.0, swap="random")
    assert len(load(alike)) == 5 + 2 * i                # what it does not depend on


def test_a_damaged_cache_is_made_again(tmp_path):
    sequences, cache = kitti.open_sequences(write_root(tmp_path / "root", size=60)), tmp_path / "cache"
    load_geometry(sequences, SMALL, cache)
    file, = cache.iterdir()
    good = file.read_bytes()
    for at in (0, 9, len(good) - 1, *generator(0).integers(len(good), size=7)):
        for bad in (good[:at], good[:at] + bytes([good[at] ^ 16]) + good[at + 1:]):
            file.write_bytes(bad)
            load_geometry(sequences, SMALL, cache)
            assert file.read_bytes() == good and [*cache.iterdir()] == [file]


def test_temporaries_of_dead_processes_go_and_those_of_living_ones_stay(tmp_path):
    dead = subprocess.run([sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True, text=True).stdout.strip()
    mine = metrics.temporary_beside(tmp_path / "a.npy")
    left = {pid: mine.with_name(mine.name.replace(str(os.getpid()), pid)) for pid in (dead, "1", "no-pid")}
    other = mine.with_name(f".b.npy.{dead}")
    for path in (*left.values(), other):
        path.write_text("")
    assert metrics.temporary_beside(tmp_path / "a.npy") == mine
    assert sorted(tmp_path.iterdir()) == sorted([left["1"], left["no-pid"], other])


def test_a_scan_changed_with_its_size_and_time_kept_is_computed_again(tmp_path):
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
    """Of a scan file, and keep its size and modification time, as `rsync -t` does."""
    data, stat = bytearray(path.read_bytes()), path.stat()
    data[len(data) // 32 * 16 + 3] ^= 128  # the sign of an x
    path.write_bytes(data)
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    assert path.stat().st_mtime_ns == stat.st_mtime_ns


def test_only_regular_files_are_replaced(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    for name in ("pipe", "folder"):
        with pytest.raises(OSError, match=f"{name}.*not a regular file"):
            metrics.write_poses(tmp_path / name, straight(2))
    assert (tmp_path / "pipe").is_fifo() and sorted(os.listdir(tmp_path)) == ["folder", "pipe"]


def test_a_full_disk_is_named_with_the_file(tmp_path):
    with pytest.raises(OSError, match=f"No space.*{tmp_path / 'a.txt'}"):
        with metrics.replacing(tmp_path / "a.txt"):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert not any(tmp_path.iterdir())


def test_default_names_of_the_same_second_differ(tmp_path, monkeypatch):
    monkeypatch.setattr(time, "strftime", lambda form: "now")
    names = []
    for _ in range(3):
        names.append(kitti.new_name(tmp_path / "runs"))
        names[-1].mkdir(parents=True)
    assert len(set(names)) == 3 and {path.parent for path in names} == {tmp_path / "runs"}


def test_a_pose_file_may_begin_with_a_byte_order_mark_and_utf_16_is_named(tmp_path):
    path, T = tmp_path / "a.txt", straight(3)
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


def test_a_run_folder_has_one_writer_and_a_killed_one_leaves_it_free(tmp_path):
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
    with kitti.run_folder(tmp_path / "run"):  # it is free, and says who has it now
        assert (tmp_path / "run" / "lock").read_text().startswith(f"process {os.getpid()} on ")


UNGUARDED = """
import multiprocessing, kitti
multiprocessing.set_start_method("spawn", force=True)
try:
    print([*kitti.in_processes(abs, [1, 2], workers=1)])
except OSError as error:
    print(error)
"""


def test_a_script_without_a_guard_is_told_what_is_missing(tmp_path):
    (tmp_path / "script.py").write_text(UNGUARDED)
    environment = os.environ | {"PYTHONPATH": str(HERE)}
    ran = subprocess.run([sys.executable, tmp_path / "script.py"], env=environment, timeout=60,
                         capture_output=True, text=True)
    line, = ran.stdout.splitlines()
    assert "if __name__ == '__main__':" in line and ran.returncode == 0


# --------------------------------------------------------------------------------------------------- weights and odometry

def save_weights(path, config=Config(), **facts):
    """A file as `fit` writes it, of a network that was never trained."""
    net = a_net(generator(0), config)
    d3dlo.save(path, config=config.as_dict(), model=net.state_dict(), step=0, **FACTS | facts)
    return net


@table("config", {"small": replace(SMALL, batch=3, swap="random", sa1=Layer(1.5, 40, 5, (6, 10))), "default": Config()})
def test_weights_rebuild_their_network_from_the_file_itself(tmp_path, config):
    net, rng = save_weights(tmp_path / "weights.pt", config), generator(0)
    p, q = cloud(rng, 1100), cloud(rng, 1100)
    for path in (tmp_path / "weights.pt", tmp_path):    # a file, or the run folder that holds it
        loaded, _ = load_weights(path)
        assert loaded.config == config and not loaded.training
        assert_array_equal(predict(loaded, p, q), predict(net, p, q))


@pytest.fixture(scope="session")
def new_drive(tmp_path_factory):
    """A simulated sequence that the shipped weights have not seen, and its geometry for them."""
    root = tmp_path_factory.mktemp("new")
    s, = kitti.open_sequences(kitti.simulate(root, seed=1, sequences=["06"], scans=8, workers=1))
    config = load_weights()[0].config
    return s, np.stack([scan_geometry(s.scan(i), config) for i in range(8)])


def test_the_weights_shipped_follow_a_drive_they_have_not_seen(new_drive):
    (s, records), (net, _) = new_drive, load_weights()
    poses = d3dlo.accumulate(d3dlo.predict_motions(net, records, refine=1))
    moved = np.linalg.norm(s.motions()[:, :3, 3], axis=1)
    t, r = metrics.step_errors(s.poses, poses).mean(0)
    assert count(net) == 61290 and moved.mean() > 0.5 and t < 0.15 and r < 0.2


@torch.inference_mode()
def test_in_bfloat16_the_shipped_weights_predict_nearly_the_same(new_drive):
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
    rng, w = generator(seed), tmp_path / "w.pt"
    net, scans, expected = save_weights(w, SMALL), [cloud(rng, 60) for _ in range(5)], np.eye(4)
    odometry = d3dlo.Odometry(w)
    for i, scan in enumerate(scans):
        for bad in (scan[:, :3], scan[0], scan[:10], scan * np.nan, scan + 99, scan * np.float32([1, 1, 1, 3e38])):
            with pytest.raises(ValueError):
                odometry.register(bad)
        expected = expected @ d3dlo.relative_pose(scans[i - 1], scan, w) if i else expected
        pose = odometry.register(scan)
        assert pose.shape == (4, 4) and pose.dtype == float
        assert_allclose(pose, expected, atol=1e-9)
        pose[:] = 0                                     # a copy: the next pose does not mind
    together = d3dlo.predict_motions(net, np.stack([scan_geometry(s, SMALL) for s in scans]), batch=3)      # and several pairs at a time
    assert_allclose(d3dlo.accumulate(together)[-1], expected, atol=1e-3)


@given(SEED)
def test_refining_answers_both_ways_and_again_for_what_is_left(seed):
    def one_way(p, q):                                  # in place of the network: small, smooth, and not the same both ways
        return from_vector((p["xyz"][:2] - 0.7 * q["xyz"][1:3]).ravel() / 10)

    def half_way(p, q):
        forward, backward = one_way(p, q), invert(one_way(q, p))
        T = (forward + backward) / 2
        T[:3, :3] = Rotation.from_matrix([forward[:3, :3], backward[:3, :3]]).mean().as_matrix()
        return T
    rng = generator(seed)
    records = np.stack([scan_geometry(cloud(rng, 48), SMALL) for _ in range(4)])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(d3dlo, "predict", lambda net, clouds, p, q, device: np.stack([one_way(*clouds[[i, j]]) for i, j in zip(p, q)]))
        motions = d3dlo.predict_motions(None, records, batch=2, refine=2)
    for T, p, q in zip(motions, records[:-1], records[1:], strict=True):
        expected = half_way(p, q)
        for _ in range(2):
            expected = half_way(p, d3dlo.move_scans(q[None], expected[None])[0]) @ expected     # see the test of augment
        assert_allclose(T, expected, atol=1e-3)


@pytest.mark.parametrize("refine", [-1, 1.5, "1", None, float("nan")])
def test_a_number_of_refinements_that_makes_no_sense_is_refused(weights, refine):
    scan = np.ones((2000, 4), np.float32)
    for call in (lambda: d3dlo.Odometry(weights, refine=refine),
                 lambda: d3dlo.relative_pose(scan, scan, weights, refine),
                 lambda: d3dlo.evaluate(weights=weights, refine=refine)):
        with pytest.raises(ValueError, match="refine"):
            call()


NAN = float("nan")


@table("settings, named", {str(settings): (settings, named) for settings, named in [
    (dict(epochs=1.5), "epochs"), (dict(epochs=0), "epochs"), (dict(batch=NAN), "batch"),
    (dict(sa1=Config.sa1._replace(r=-1.0)), "radius"),
    (dict(sa2=Config.sa2._replace(r=NAN)), "radius"),
    (dict(sa3=Config.sa3._replace(r=0)), "radius"), (dict(max_range=-50.0), "max_range"),
    (dict(max_range=NAN), "max_range"), (dict(max_range=0), "max_range"), (dict(lr=NAN), "lr"),
    (dict(lr=-1e-3), "lr"), (dict(lr=float("inf")), "lr"), (dict(frozen=1.0), "frozen"),
    (dict(frozen=-0.1), "frozen"), (dict(frozen=NAN), "frozen"),
    (dict(sa1=Config.sa1._replace(n_n=99999999)), "n_n"),
    (dict(fe=Config.fe._replace(n_n=0)), "n_n"),
    (dict(sa1=Config.sa1._replace(n_fps=65536)), "n_fps"),
    (dict(sa3=Config.sa3._replace(n_fps=257)), "n_fps"), (dict(plane="no"), "plane"),
    (dict(augment=2), "augment"), (dict(optimizer="sgd"), "optimizer"),
    (dict(schedule="cosine"), "schedule"), (dict(swap="always"), "swap"),
    (dict(mlp=Layer(None, None, None, (64, 7))), "mlp"),
    (dict(mpn=Layer(None, None, None, ())), "MLP")]})
def test_a_config_that_makes_no_sense_is_refused_by_name(settings, named):
    with pytest.raises(ValueError, match=rf"Config: .*{named}"):
        Config(**settings)


@pytest.mark.filterwarnings("ignore")
@table("scene", {       # scans (N,4) of which the default network must make a rigid motion
    "an empty field": lambda rng: np.c_[rng.uniform(-50, 50, (5000, 2)), np.full(5000, -1.73), np.full(5000, 0.3)],
    "a corridor": lambda rng: np.c_[rng.uniform(-80, 80, 5000), rng.choice([-2, 2], 5000), rng.uniform(-1, 2, 5000), np.full(5000, 0.3)],
    "exactly 1,024 points": lambda rng: cloud(rng, 1024),
    "all points at one place": lambda rng: np.ones((2000, 4)),
    "all points at the sensor": lambda rng: np.zeros((2000, 4)),
    "1,000,000 points": lambda rng: cloud(rng, 1_000_000),
})
def test_degenerate_scenes_end_in_a_rigid_motion(tmp_path, scene):
    save_weights(tmp_path / "w.pt")
    p = scene(generator(0)).astype(np.float32)
    for q in (p, moved_scan(from_vector([0, 0, 0, 0, 0, 180]), p)):                 # standing still, turned round
        for refine in (0, 1):
            T = d3dlo.relative_pose(p, q, tmp_path / "w.pt", refine)
            assert_allclose(T @ invert(T), np.eye(4), atol=1e-9)                    # NaN is not close


@given(st.lists(st.floats(0.1, 10), min_size=4, max_size=4), st.lists(st.floats(1, 5), min_size=4, max_size=4))
def test_what_is_unlike_is_named(share, spread):
    low, high = np.arange(1.0, 5), np.arange(1.0, 5) * spread
    looks = low * share
    for name, x, a, b in zip(kitti.STATS, looks, low, high):
        assert (name in kitti.domain_shift(looks, [low, high])) == (x < a / 1.5 or x > b * 1.5)


def test_odometry_and_eval_say_once_what_is_strange_about_scans(here, capsys):
    save_weights(here / "w.pt", seen=[[1e5, 0.1, 1, 0.01], [2e5, 1, 100, 1]])
    odometry, scans = d3dlo.Odometry(here / "w.pt"), [cloud(generator(i), 1100) for i in range(3)]
    with pytest.warns(UserWarning) as said:
        for scan in (*scans, np.insert(scans[0], 7, np.nan, axis=0)):
            odometry.register(scan)
    unlike, broken = (str(warning.message) for warning in said)
    assert "usable points 1.1e+03 (in training 1e+05" in unlike and "dropped 1 " in broken
    rewrite(SCAN, lambda b: b"\xff" * 16 + b)(write_root(here / "root"))
    assert d3dlo.main(["eval", "--data", "root", "--weights", "w.pt", "--out", "out"]) == 0
    broken, unlike = complaint(capsys.readouterr().err)
    assert "sequence 00" in unlike and "usable points" in unlike and "dropped 1 " in broken


# ---------------------------------------------------------------------------------------------------------- command line

@pytest.fixture
def here(tmp_path, monkeypatch):
    """Runs and caches go to the current folder."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="session")
def weights(tmp_path_factory):
    save_weights(path := tmp_path_factory.mktemp("weights") / "weights.pt")
    return path


def complaint(err):
    """What is on stderr beside lines of progress."""
    return [line for line in err.splitlines() if line.strip() and not re.search(r": \d+/\d+, .* left$", line.strip())]


def fails_with_one_line(main, arguments, words, capsys):
    code = main(list(map(str, arguments)))
    out, err = capsys.readouterr()
    assert code == 2 and len(complaint(err)) == 1 and words in complaint(err)[0] and "Traceback" not in err + out, err


def figures(out, name):
    """The row `name` of a printed table, the star of what was trained on aside: [segments, E_t, E_r, t step, r step, ...]."""
    return re.search(rf"^{name}(?: \*)? +(\S.*)$", out, re.M)[1].split()


def as_printed(s):
    formats = {"segments": "d", "E_t": ".3f", "E_r": ".5f", "t_step_m": ".4f", "r_step_deg": ".4f"}
    return ["-" if s[key] is None else format(s[key], f) for key, f in formats.items()]


def test_eval_writes_what_it_prints_and_metrics_agrees_and_zips_what_the_server_wants(here, weights, capsys):
    server = [f"{i}" for i in range(11, 22)]            # KITTI's sequences without ground truth get their trajectories all the same
    shutil.rmtree(write_root(here / "root", server, scans=2) / "poses")
    root, segments = write_root(here / "root", ("03", "07"), scans=15, step=14), []             # steps of 11 m: there are segments
    (root / "sequences" / "05").mkdir()                 # calibrations come for all sequences, scans perhaps not
    assert d3dlo.main(["eval", "--data", "root", "--weights", str(weights), "--out", "out"]) == 0
    out, err = capsys.readouterr()
    results, (net, _) = json.loads((here / "out" / "results.json").read_text()), load_weights(weights)
    names = ["03", "07", *server]
    assert complaint(err) == [] and sorted(os.listdir("out")) == [*(f"{name}.txt" for name in names), "kitti-server.zip", "results.json"]
    assert list(results["sequences"]) == names and set(results["splits"]) == {"test", "validation"}
    for name, s in [*results["sequences"].items(), ("all", results["pooled"])]:
        assert figures(out, name) == as_printed(s) and s["trained_on"] is False
    assert results["sequences"]["11"]["E_t"] is None
    for s in kitti.open_sequences(root, ["03", "07"]):  # once more, from the files
        T, got = metrics.read_poses(here / "out" / f"{s.name}.txt"), results["sequences"][s.name]
        segments.append(devkit(s.poses_cam, T)[:, 3:])
        steps = metrics.step_errors(s.poses, kitti.camera_to_velo(T, s.Tr)).mean(0)
        assert_allclose([got["E_t"], got["E_r"], got["t_step_m"], got["r_step_deg"]], [*segments[-1].mean(0), *steps], rtol=1e-5)
        expected = d3dlo.accumulate([from_vector(predict(net, s.scan(i), s.scan(i + 1))) for i in range(14)])
        assert_allclose(kitti.camera_to_velo(T, s.Tr), expected, rtol=1e-3, atol=1e-3)
    assert_allclose([results["pooled"][key] for key in ("E_t", "E_r")], np.concatenate(segments).mean(0), rtol=1e-5)
    assert metrics.main(["root/poses", "out"]) == 0     # in the camera's frame: the same segments, other steps
    out = capsys.readouterr().out
    assert all(figures(out, name)[:3] == as_printed(results["sequences"][name])[:3] for name in ("03", "07"))
    with zipfile.ZipFile("out/kitti-server.zip") as archive:                        # in its root, in the format of the ground truth
        assert archive.namelist() == [f"{name}.txt" for name in server]
        for name in archive.namelist():
            assert archive.read(name) == Path("out", name).read_bytes() and np.loadtxt(archive.open(name)).shape == (2, 12)


@pytest.mark.parametrize("save, name, scale", [(save_bin, "{}.bin", 1), (np.save, "{}.npy", 255)])
def test_eval_takes_a_plain_folder_of_scans(here, weights, capsys, save, name, scale):
    scans = write_folder(here / "drive", size=1100, save=save, name=name, scale=scale)
    arguments = ["eval", "--data", "drive", "--weights", str(weights), "--out"]
    assert d3dlo.main([*arguments, "out"]) == 0
    (out, err), (net, _) = capsys.readouterr(), load_weights(weights)
    scans = [scan / np.float32([1, 1, 1, scale]) for scan in scans]
    expected = d3dlo.accumulate([from_vector(predict(net, p, q)) for p, q in zip(scans, scans[1:])])
    poses, rows = metrics.read_poses("out/poses.txt"), np.loadtxt("out/poses.tum")
    assert sorted(os.listdir("out")) == ["poses.tum", "poses.txt", "results.json"]
    assert_allclose(poses, expected, rtol=1e-3, atol=1e-3)
    assert_allclose(rows[:, 0], np.arange(12) / 10)
    assert_allclose(rows[:, 1:4], poses[:, :3, 3], atol=1e-6)
    assert_allclose(Rotation.from_quat(rows[:, 4:]).as_matrix(), poses[:, :3, :3], atol=1e-6)
    metres, speed = re.search(r"^drive: 12 scans, path of (\S+) m, (\S+) scans a second", out).groups()
    assert float(metres) == pytest.approx(metrics.path_lengths(poses)[-1], abs=0.06)
    assert float(speed) > 0 and complaint(err) == []
    assert "frame         of the LiDAR" in out and "out/poses.txt" in out and "out/poses.tum" in out
    assert "10 scans a second" in out and ("divided by 255" in out) == (scale > 1)
    (here / "drive" / "times.txt").write_text("\n".join(f"{7 + i}" for i in range(12)))
    assert d3dlo.main([*arguments, "again"]) == 0
    assert_allclose(np.loadtxt("again/poses.tum"), np.c_[7 + np.arange(12), rows[:, 1:]], atol=1e-8)
    assert "10 scans" not in capsys.readouterr().out


def test_a_plain_folder_is_drawn_where_there_is_matplotlib(here, weights, capsys):
    pytest.importorskip("matplotlib")
    write_folder(here / "drive", scans=3, size=1100)
    arguments = ["eval", "--data", "drive", "--weights", str(weights), "--out", "out", "--plot"]
    assert d3dlo.main(arguments) == 0 and "out/plot.png" in capsys.readouterr().out
    assert (here / "out" / "plot.png").read_bytes().startswith(b"\x89PNG")


def test_a_plain_folder_that_cannot_be_used_is_named_in_one_line(here, weights, capsys):
    write_folder(here / "drive", size=1100)
    train = ["train", "--data", "drive", "--out", "run"]
    evaluate = ["eval", "--data", "drive", "--weights", weights, "--out", "out"]
    fails_with_one_line(d3dlo.main, train, "drive has no ground truth", capsys)
    np.save(here / "drive" / "scan 2.npy", cloud(generator(0), 900))
    fails_with_one_line(d3dlo.main, evaluate, "scan 2.npy: 900 usable", capsys)
    five_floats(52)(here / "drive")
    fails_with_one_line(d3dlo.main, evaluate, "nuScenes", capsys)
    assert all(name.startswith("drive/") for name in files_of(here))    # nothing is left


def test_train_then_eval_then_train_again(here, city, capsys):
    arguments = ["train", "--data", shutil.copytree(city, "data"), "--epochs", "1", "--out", "run"]
    assert d3dlo.main(arguments) == 0
    out, err = capsys.readouterr()
    assert complaint(err) == [] and "61,290 parameters" in out and not list(here.rglob(".*"))
    run = here / "run"
    assert set(os.listdir(run)) == {
        "weights.pt", "checkpoint.pt", "config.json", "lock", "log.txt", "results"}
    trained = json.loads((run / "results" / "results.json").read_text())
    before = (run / "checkpoint.pt").read_bytes()
    assert figures(out, "07") == as_printed(trained["sequences"]["07"])
    assert (run / "log.txt").read_text() == out
    assert d3dlo.main(["eval", "--data", "data", "--weights", "run", "--out", "out"]) == 0
    results, out = json.loads((here / "out" / "results.json").read_text()), capsys.readouterr().out
    assert results["sequences"]["07"] == trained["sequences"]["07"]  # held out, evaluated at the end
    assert [s["trained_on"] for s in results["sequences"].values()] == [True, False]
    assert results["pooled"]["trained_on"]  # on one of them
    assert re.findall(r"^(\w+) \*", out, re.M) == ["00", "train", "all"]
    fails_with_one_line(d3dlo.main, arguments, "--resume", capsys)  # it is not overwritten
    shutil.copy("data/poses/07.txt", "data/poses/00.txt")
    resume = "train --out run --resume".split()
    fails_with_one_line(d3dlo.main, resume, "the data have changed", capsys)
    assert (run / "checkpoint.pt").read_bytes() == before
    arguments = "eval --data data --weights run/checkpoint.pt".split()
    fails_with_one_line(d3dlo.main, arguments, "weights.pt beside", capsys)
    shutil.copy("run/weights.pt", "run/checkpoint.pt")
    fails_with_one_line(d3dlo.main, ["train", "--out", "run", "--resume"], "no training", capsys)


def test_a_training_from_weights_begins_with_them_and_remembers_what_they_saw(here):
    write_root(here / "first")
    write_root(here / "later", size=1200)               # another sequence of the same name
    d3dlo.train(replace(SMALL, epochs=1), "first", out="a")
    d3dlo.train(Config(epochs=1, lr=1e-12), "later", out="b", weights="a")
    (a, seen_a), (b, seen_b) = (load_weights(run) for run in "ab")
    assert b.config == replace(a.config, epochs=1, batch=16, swap="random", lr=1e-12) and a.config.sa1.n_fps == 32
    assert all(torch.allclose(x, y, atol=1e-9) for x, y in zip(a.parameters(), b.parameters(), strict=True))
    assert list(seen_a["train"].values()) == seen_b["before"] and seen_a["train"] != seen_b["train"]
    (low_a, high_a), (low_b, high_b) = seen_a["seen"], seen_b["seen"]
    assert np.all(np.array(low_b) <= low_a) and np.all(np.array(high_b) >= high_a)
    shutil.rmtree("a")
    d3dlo.train(out="b", resume=True)                   # for which they are not needed any more
    assert load_weights("b")[1]["train"] == seen_b["train"]
    d3dlo.evaluate("first", "b", out="results")
    assert json.loads((here / "results" / "results.json").read_text())["sequences"]["00"]["trained_on"]


def config_of(run):
    return json.loads((Path(run) / "config.json").read_text())["config"]


def test_with_data_the_papers_settings_are_the_default_and_the_test_loss_is_logged(here):
    write_root(here / "root", ("00", "03"), scans=4)
    write_root(here / "alone", ("00",), scans=4)  # the same 00
    for root in ("root", "alone"):
        arguments = f"train --data {root} --epochs 2 --out {root}-run"
        assert d3dlo.main(arguments.split()) == 0
        assert config_of(f"{root}-run") == Config(epochs=2).as_dict()
    log = (here / "root-run" / "log.txt").read_text()
    losses = re.findall(r"^epoch (\d)/2: loss [\d.]+, test loss [\d.]+, learning", log, re.M)
    assert losses == ["1", "2"]
    assert "test loss" not in (here / "alone-run" / "log.txt").read_text()
    assert_same_model(stored(here / "root-run"), stored(here / "alone-run"))


@pytest.mark.parametrize("short", [True, False])
def test_a_recipe_does_not_change_the_network_and_input_of_given_weights(here, short):
    network = dict(max_range=30.0, plane=False, sa1=SMALL.sa1._replace(n_n=5))
    save_weights("w.pt", replace(SMALL, **network, epochs=77, lr=0.5, frozen=0.5))
    write_root(here / "root", scans=4)
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
def test_results_are_never_written_among_the_data(here, capsys, out):
    write_root(here / "root", size=60)
    (here / "link").symlink_to("root/poses")
    save_weights("w.pt", SMALL)
    before, folders = files_of(here), sorted(here.rglob("*"))
    for command in ("eval --weights w.pt", "train --epochs 1"):
        arguments = [*command.split(), "--data", "root", "--out", out]
        fails_with_one_line(d3dlo.main, arguments, "--out", capsys)
    assert files_of(here) == before and sorted(here.rglob("*")) == folders


def test_eval_used_again_removes_what_the_earlier_evaluation_listed_and_nothing_else(here):
    write_root(here / "root", ("03", "07"), size=60)
    save_weights("w.pt", SMALL)
    (here / "root" / "notes.txt").write_text("mine")

    def evaluate(*sequences):
        d3dlo.evaluate("root", "w.pt", sequences, "out")
        return set(os.listdir("out"))
    assert evaluate("03", "07") == {"03.txt", "07.txt", "results.json"}
    for name in ("notes.txt", "00.txt"):
        (here / "out" / name).write_text("mine")
    assert evaluate("07") == {"07.txt", "results.json", "notes.txt", "00.txt"}
    content = json.loads((here / "out" / "results.json").read_text())
    content["files"] += ["../root/notes.txt", str(here / "w.pt"), "gone.txt"]  # not of this folder
    (here / "out" / "results.json").write_text(json.dumps(content))
    assert evaluate("03") == {"03.txt", "results.json", "notes.txt", "00.txt"}
    assert (here / "root" / "notes.txt").read_text() == "mine" and (here / "w.pt").exists()
    for content in ("[]", '{"files": null}', '{"files": [1]}', "no JSON"):  # not one of ours
        (here / "out" / "results.json").write_text(content)
        assert evaluate("03") == {"03.txt", "results.json", "notes.txt", "00.txt"}


def test_eval_refines_as_often_as_asked(here):
    s, = kitti.open_sequences(write_root(here / "root", size=60))
    net = save_weights("w.pt", SMALL)
    records = np.stack([scan_geometry(s.scan(i), SMALL) for i in range(6)])
    assert d3dlo.main("eval --data root --weights w.pt --refine 2 --out out".split()) == 0
    got = kitti.camera_to_velo(metrics.read_poses("out/00.txt"), s.Tr)
    plain, twice = (d3dlo.accumulate(d3dlo.predict_motions(net, records, refine=n)) for n in (0, 2))
    assert_allclose(got, twice, atol=1e-3)
    assert np.abs(got - plain).max() > 0.1


def test_the_baselines_stand_still_or_repeat_the_mean_motion_of_training(here, capsys):
    mean = [10.0, 1, 0, 0, 0, 3]
    s, = kitti.open_sequences(write_root(here / "root", ("03",), scans=15, size=60, step=14))
    save_weights("w.pt", SMALL, mean_motion=mean)
    assert d3dlo.main("eval --data root --weights w.pt --out out".split()) == 0
    out, results = capsys.readouterr().out, json.loads((here / "out" / "results.json").read_text())
    for name, v in {"standing still": [0] * 6, "mean motion of training": mean}.items():
        motion = by_hand(np.array(v))
        T = [np.linalg.matrix_power(motion, i) for i in range(15)]
        errors = np.linalg.inv(motion) @ s.motions()
        steps = [np.linalg.norm(errors[:, :3, 3], axis=1),
                 np.degrees(Rotation.from_matrix(errors[:, :3, :3]).magnitude())]
        segments = devkit(s.poses_cam, s.Tr @ T @ np.linalg.inv(s.Tr))[:, 3:]
        expected = [*segments.mean(0), *np.mean(steps, 1)]
        for group in (results["pooled"], results["splits"]["test"]):
            got = [group[name][key] for key in ("E_t", "E_r", "t_step_m", "r_step_deg")]
            assert_allclose(got, expected, rtol=1e-6)
        assert figures(out, f"  {name}") == as_printed(results["pooled"][name])


def test_neighbors_and_no_plane_are_settings_of_the_network_trained(here):
    write_root(here / "root", scans=3, size=1500)
    arguments = "train --data root --neighbors 5 --no-plane --epochs 1 --out run"
    assert d3dlo.main(arguments.split()) == 0
    expected = Config(epochs=1, plane=False, sa1=Layer(1.0, 1024, 5, (4, 8, 16, 32)))
    assert load_weights("run")[0].config == expected


def test_the_seed_sets_the_first_weights_and_the_mean_motion_is_stored(here):
    s, = kitti.open_sequences(write_root(here / "root", size=60))
    first = []
    for run, seed in enumerate((0, 0, 1)):
        d3dlo.train(replace(SMALL, epochs=1, lr=1e-12), "root", out=f"run{run}", seed=seed)
        net, state = load_weights(f"run{run}")
        first.append(net.sa2.mpn.h[0].weight.detach())
        assert_allclose(state["mean_motion"], to_vector(s.motions()).mean(0), atol=1e-6)
    assert torch.equal(first[0], first[1]) and (first[0] - first[2]).abs().max() > 0.01


def test_a_run_folder_in_use_is_refused_in_one_line_that_names_the_process(here):
    write_root(here / "root", scans=2)
    with kitti.run_folder(here / "run"):
        arguments = "train --data root --out run".split()
        ran = subprocess.run([sys.executable, HERE / "d3dlo.py", *arguments],
                             capture_output=True, text=True, timeout=60)
    line, = complaint(ran.stderr)
    assert ran.returncode == 2 and f"process {os.getpid()} on" in line and "run:" in line
    assert not (here / "run").exists() and not (here / "cache").exists()


def test_a_run_is_not_resumed_with_a_scan_changed_in_its_middle(here, capsys):
    root = write_root(here / "root", size=60)
    d3dlo.train(replace(SMALL, epochs=1), "root", out="run")
    change_in_the_middle(root / SCAN)
    fails_with_one_line(d3dlo.main, "train --out run --resume".split(), "data have changed", capsys)


def test_train_says_in_one_line_that_the_loss_diverged(here, capsys):
    write_root(here / "root")
    arguments = "train --data root --epochs 50 --batch 2 --lr 1e30 --out run"
    fails_with_one_line(d3dlo.main, arguments.split(), "step 1, learning rate 1.0e+30", capsys)
    assert set(os.listdir("run")) == {"config.json", "lock", "log.txt"}


def test_a_training_run_whose_output_nobody_reads_is_resumed_to_the_same_weights(
        here, monkeypatch, capsys):
    class Closed(io.StringIO):  # as by `| head -3`
        def write(self, text):
            if "epoch 1/" in text:
                raise BrokenPipeError
            return super().write(text)
    write_root(here / "root", scans=4)
    arguments = "train --data root --epochs 2 --batch 2 --out".split()
    assert d3dlo.main([*arguments, "whole"]) == 0
    capsys.readouterr()
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", Closed())
        assert d3dlo.main([*arguments, "run"]) == 2
    line, = complaint(capsys.readouterr().err)
    assert "--resume" in line and stored(here / "run", "checkpoint.pt")["step"] == 1
    assert d3dlo.main("train --out run --resume".split()) == 0
    assert_same_model(stored(here / "run"), stored(here / "whole"))


def test_an_interruption_while_the_cache_is_made_leaves_no_run_to_resume(here, monkeypatch, capsys):
    def interrupt(*arguments):
        raise KeyboardInterrupt
    write_root(here / "root", scans=3)
    monkeypatch.setattr(kitti, "in_processes", interrupt)
    assert d3dlo.main("train --data root --out runs/run".split()) == 130
    line, = complaint(capsys.readouterr().err)
    assert "run the same command again" in line and not (here / "runs").exists()


def test_a_full_disk_is_said_in_one_line(here, monkeypatch, capsys):
    def full(*arguments, **options):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    write_root(here / "root", size=60)
    save_weights("w.pt", SMALL)
    monkeypatch.setattr(np, "savetxt", full)
    arguments, words = "eval --data root --weights w.pt --out out", "No space left on device: 'out/"
    fails_with_one_line(d3dlo.main, arguments.split(), words + "00.txt'", capsys)


def test_the_version_is_printed(capsys):
    with pytest.raises(SystemExit) as end:
        d3dlo.main(["--version"])
    assert end.value.code == 0 and capsys.readouterr().out == f"d3dlo {d3dlo.__version__}\n"
    assert re.fullmatch(r"\d+\.\d+\.\d+", d3dlo.__version__)


def rewrite(name, change):
    return lambda root: (root / name).write_bytes(change((root / name).read_bytes()))


SCAN, POSES, CALIB = "sequences/00/velodyne/000005.bin", "poses/00.txt", "sequences/00/calib.txt"


@table("spoil, words", {        # what is done to a good root, and what the complaint must name
    "no sequences": (lambda root: shutil.rmtree(root / "sequences"),
                     "a folder of *.bin or *.npy files, and KITTI's odometry layout, ROOT/sequences/00/"),
    "raw layout": (lambda root: (root / "sequences").rename(root / "2011_09_26_drive_0005_sync"),
                   "kitti.py raw DRIVE ROOT"),
    "no scans": (lambda root: shutil.rmtree((root / SCAN).parent), "velodyne"),
    "a scan missing": (lambda root: (root / SCAN).with_name("000002.bin").unlink(), "000002.bin"),
    "a scan cut short": (rewrite(SCAN, lambda b: b[:-3]), SCAN),
    "an empty scan": (rewrite(SCAN, lambda b: b""), SCAN),
    "another format": (rewrite(SCAN, lambda b: b"\x93NUMPY" + b[:-6]), SCAN),
    "too few points": (rewrite(SCAN, lambda b: b[:16 * 1000]), f"{SCAN}: 1000 usable"),
    "a pose too few": (rewrite(POSES, lambda b: b"\n".join(b.splitlines()[1:])), POSES),
    "a pose of 11": (rewrite(POSES, lambda b: b.rstrip().rpartition(b" ")[0]), f"{POSES}, line 6: 11 words"),
    "a pose of 13": (rewrite(POSES, lambda b: b.replace(b"\n", b" 0\n", 1)), f"{POSES}, line 1: 13 words"),
    "a pose of words": (rewrite(POSES, lambda b: b + b"frame 1"), f"{POSES}, line 7: 2 words"),
    "a pose at infinity": (rewrite(POSES, lambda b: b.rstrip().rpartition(b" ")[0] + b" inf"), f"{POSES}, line 6: 12 words"),
    "a pose that is no rotation": (rewrite(POSES, lambda b: b.replace(b"\n", b"\n9", 1)), f"{POSES}: pose 1"),
    "a pose that mirrors": (rewrite(POSES, lambda b: b"-" + b), f"{POSES}: pose 0"),
    "no pose": (rewrite(POSES, lambda b: b"\n\n"), f"{POSES}: holds no pose"),
    "no calibration": (lambda root: (root / CALIB).unlink(), CALIB),
    "calibration without Tr": (rewrite(CALIB, lambda b: b.partition(b"Tr")[0]), CALIB),
    "Tr of 11": (rewrite(CALIB, lambda b: b.rstrip().rpartition(b" ")[0]), CALIB),
})
def test_bad_data_is_named_in_one_line_and_leaves_nothing_behind(here, weights, capsys, spoil, words):
    spoil(root := write_root(here / "root"))
    fails_with_one_line(d3dlo.main, ["eval", "--data", root, "--weights", weights, "--out", "out"], words, capsys)
    fails_with_one_line(d3dlo.main, ["train", "--data", root, "--epochs", 1, "--out", "run"], words, capsys)
    assert [name for name in files_of(here) if not name.startswith("root/")] == []


@pytest.mark.parametrize("arguments, words", {  # words: what the complaint must name
    "eval --data root --sequences 42": "42",
    "eval --data root --sequences ../sequences/00": "../sequences/00",
    "eval --data gone": "gone",
    "eval --data root --weights gone.pt": "gone.pt",
    "eval --data root --weights root": "root/weights.pt",
    "eval --sequences 0O": "0O",  # of the simulated city
    "eval --data root --device nonsense": "nonsense",
    "eval --data root --device meta": "--device meta",
    "eval --data root --refine -1": "refine",
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
    "train --data root --device meta": "--device meta",
}.items())
def test_bad_arguments_are_named_in_one_line(here, capsys, arguments, words):
    write_root(here / "root")
    before = sorted(here.rglob("*"))
    fails_with_one_line(d3dlo.main, arguments.split(), words, capsys)
    assert sorted(here.rglob("*")) == before


def torch_bytes(content):
    torch.save(content, "content.pt")
    return Path("content.pt").read_bytes()


@table("spoil", {       # the bytes of a good file -> those of a bad one
    "another shape": lambda good: torch_bytes({**torch.load("good.pt"), "config": Config().as_dict()}),
    "other numbers": lambda good: torch_bytes((state := torch.load("good.pt")) | {"model": {k: v + 1 for k, v in state["model"].items()}}),
    "code": lambda good: pickle.dumps(Mischief(), protocol=2), "code by torch": lambda good: torch_bytes({"model": Mischief()}),
    "cut short": lambda good: good[:-2000], "no config": lambda good: torch_bytes({"model": {}}), "a list": lambda good: torch_bytes([1.0]),
    "noise": lambda good: generator(0).bytes(5000), "empty": lambda good: b"", "text": lambda good: b"hello",
})
def test_files_that_are_no_weights_are_named_in_one_line_and_run_no_code(here, capsys, spoil):
    write_root(here / "root", size=40)
    save_weights("good.pt", SMALL)
    (here / "bad.pt").write_bytes(spoil((here / "good.pt").read_bytes()))
    fails_with_one_line(d3dlo.main, ["eval", "--data", "root", "--weights", "bad.pt", "--out", "out"], "bad.pt", capsys)
    assert not (here / "out").exists() and not (here / "mischief").exists()


def test_metrics_on_the_command_line(here, capsys):
    gt, est = straight(300), straight(300, 1.01)
    files = {"gt/03": gt, "gt/07": gt[:200], "est/03": est, "est/07": gt[:200], "short": gt[:20]}
    for name, T in files.items():
        metrics.write_poses(f"{name}.txt", T)
    assert metrics.main(["short.txt", "short.txt"]) == 0
    assert figures(capsys.readouterr().out, "short")[:4] == ["0", "-", "-", "0.0000"]
    assert metrics.main(["gt/03.txt", "est/03.txt"]) == 0
    expected, out = devkit(gt, est)[:, 3], capsys.readouterr().out
    ate = math.sqrt(sum((0.01 * i) ** 2 for i in range(300)) / 300)
    assert figures(out, "03")[5:] == [f"{ate:.3f}", "0.0100", "0.0000"]
    E_t = f"{expected.mean():.3f}"
    assert figures(out, "03")[:5] == [str(len(expected)), E_t, "0.00000", "0.0100", "0.0000"]
    assert figures(out, "100 m")[1] == "1.010" and figures(out, "200 m")[1] == "1.005"
    assert metrics.main(["gt", "est"]) == 0
    pooled = np.r_[expected, devkit(gt[:200], gt[:200])[:, 3]]  # 07 is shorter, and without error
    assert figures(capsys.readouterr().out, "all")[1] == f"{pooled.mean():.3f}"
    for bad in (["gt/03.txt", "gone.txt"], ["gt/03.txt", "short.txt"], ["gt", "est/03.txt"],
                ["gt", str(here)]):
        fails_with_one_line(metrics.main, bad, bad[1], capsys)


def test_a_picture_never_replaces_the_poses_it_is_drawn_from(here, capsys):
    for name in ("gt/00", "est/00"):
        metrics.write_poses(f"{name}.txt", straight(5))
    before = files_of(here)
    for pair in (["gt/00.txt", "est/00.txt"], ["gt", "est"]):
        for plot in ("gt/00.txt", "est/../est/00.txt"):
            fails_with_one_line(metrics.main, [*pair, "--plot", plot], "--plot", capsys)
    assert files_of(here) == before


def test_simulate_on_the_command_line(here, city, capsys):
    arguments = ["simulate", "city", "--sequences", "07", "--scans", "8", "--azimuth", "300"]
    assert kitti.main(arguments) == 0
    assert "8 scans" in capsys.readouterr().out and files_of("city").items() <= files_of(city).items()
    write_root(here / "real")
    before = files_of(here)
    for change, words in {"--azimuth 400": "07", "--azimuth 3": "azimuth", "--scans 0": "scans", "--sequences ../x": "../x"}.items():
        fails_with_one_line(kitti.main, arguments + change.split(), words, capsys)
    fails_with_one_line(kitti.main, ["simulate", "real", "--sequences", "00", "--scans", "2"], "00", capsys)        # never over real data
    assert files_of(here) == before and not list(here.rglob(".*"))


DRIVE = "2011_09_26/2011_09_26_drive_0013_sync"


def imu_pose(t):
    """T_wi (4,4) of the vehicle of `write_raw` after t seconds: 12 m/s on a climbing bend."""
    yaw, radius = 0.4 + 0.3 * t, 12 / 0.3
    position = [radius * np.sin(yaw), -radius * np.cos(yaw), 100 + 0.5 * t]    # east, north, up
    return by_hand(np.r_[position, np.degrees([0.03, 0.05, yaw])])


def write_raw(folder, scans=12):
    """A drive as KITTI's raw data -> true poses of the rectified camera (scans,4,4), Tr (4,4)."""
    rng, drive = generator(0), folder / DRIVE
    times = {"velodyne_points": 0.1 * np.arange(scans) + rng.uniform(-0.004, 0.004, scans)}
    times["oxts"] = times["velodyne_points"] + 0.015 + rng.uniform(-0.01, 0.01, scans)
    for stream, seconds in times.items():
        (drive / stream / "data").mkdir(parents=True)
        stamps = np.datetime64("2011-09-26T23:59:59.5", "ns") + (1e9 * seconds).astype(int)
        lines = [f"{stamp}\n".replace("T", " ") for stamp in stamps]                # past midnight
        (drive / stream / "timestamps.txt").write_text("".join(lines))
    T_oxts = [imu_pose(t) for t in times["oxts"]]
    scale = 6378137 * np.cos(np.radians(49))            # of Mercator at the first packet's latitude
    for i, (t, T) in enumerate(zip(times["oxts"], T_oxts)):
        cloud(rng, 40).tofile(drive / "velodyne_points" / "data" / f"{i:010d}.bin")
        east, north, up = T[:3, 3] - T_oxts[0][:3, 3]
        stretched = np.arctanh(np.sin(np.radians(49))) + north / scale              # Mercator's y
        lat, lon = np.degrees(np.arcsin(np.tanh(stretched))), 8.4 + np.degrees(east / scale)
        yaw = 0.4 + 0.3 * t
        packet = np.full(30, 77.0)                      # what is not used
        packet[:11] = lat, lon, up, 0.03, 0.05, yaw, 12 * np.sin(yaw), 12 * np.cos(yaw), 77, 77, 0.5
        packet[17:20] = T[:3, :3].T @ [0, 0, 0.3]       # the vehicle's own axes
        np.savetxt(drive / "oxts" / "data" / f"{i:010d}.txt", packet[None], fmt="%.17g")
    T_velo_imu = motion(rng)
    T_cam_velo = by_hand(np.array([0, -0.1, -0.3, -90, 1, -91]))
    rectify = by_hand(np.array([0, 0, 0, 1, 2, 3.0]))
    numbers = lambda array: " ".join(map(repr, array.ravel().tolist()))
    for name, T in ("imu_to_velo", T_velo_imu), ("velo_to_cam", T_cam_velo):
        (drive.parent / f"calib_{name}.txt").write_text(
            f"calib_time: 25-May-2012\nR: {numbers(T[:3, :3])}\nT: {numbers(T[:3, 3])}\n")
    (drive.parent / "calib_cam_to_cam.txt").write_text(
        f"R_00: {numbers(np.eye(3))}\nR_rect_00: {numbers(rectify[:3, :3])}\n")
    T_imu_cam = np.linalg.inv(rectify @ T_cam_velo @ T_velo_imu)
    T_wc = [imu_pose(t) @ T_imu_cam for t in times["velodyne_points"]]
    return np.linalg.inv(T_wc[0]) @ T_wc, rectify @ T_cam_velo


def test_a_raw_drive_is_converted_with_poses_of_the_time_of_its_scans(here, capsys):
    truth, Tr = write_raw(here)
    assert kitti.main(["raw", DRIVE, "root"]) == 0
    out, err = capsys.readouterr()
    s, = kitti.open_sequences("root")
    assert s.name == "2011_09_26_drive_0013" and complaint(err) == []
    assert "root: 1 sequences, 12 scans" in out and "split" not in out
    assert re.search(r"scans 0 to 11, 13\.\d m", out)   # 1.1 s at 12 m/s
    assert_allclose(s.Tr, Tr, atol=1e-9)
    assert_allclose(s.poses_cam, truth, atol=1e-3)      # 1 mm
    assert metrics.step_errors(truth, s.poses_cam).max() < 1e-3
    assert_allclose(np.loadtxt(s.folder / "times.txt"), 0.1 * np.arange(12), atol=0.01)
    for scan, path in zip(sorted((here / DRIVE).rglob("*.bin")), s.scan_paths, strict=True):
        assert path.samefile(scan)                      # takes no room
    before = files_of(here)
    fails_with_one_line(kitti.main, ["raw", DRIVE, "root"], "drive_0013 is there already", capsys)
    assert files_of(here) == before


def test_scans_of_a_raw_drive_are_copied_where_they_cannot_be_linked(here, monkeypatch):
    write_raw(here)
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
    return lambda drive: [(drive / pattern.format(i)).unlink() for i in numbers]


def blank_lines(name, numbers):
    def spoil(drive):
        lines = (drive / name).read_text().splitlines()
        kept = ["" if i in numbers else line for i, line in enumerate(lines)]
        (drive / name).write_text("\n".join(kept))
    return spoil


@table("spoil, parts", {       # what is missing; the first and the last scan of each sequence
    "scans": (delete("velodyne_points/data/{:010d}.bin", (3, 4)), [(0, 2), (5, 11)]),
    "a time": (blank_lines("velodyne_points/timestamps.txt", [7]), [(0, 6), (8, 11)]),
    "packets": (delete("oxts/data/{:010d}.txt", (4, 5, 6)), [(0, 4), (7, 11)]),
    "times of packets": (blank_lines("oxts/timestamps.txt", (4, 5, 6)), [(0, 4), (7, 11)]),
})
def test_a_raw_drive_is_split_where_something_is_missing(here, capsys, spoil, parts):
    truth, _ = write_raw(here)
    spoil(here / DRIVE)
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


@table("spoil, words", {       # what is done to a good drive; what the message must name
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
def test_a_raw_drive_that_is_incomplete_or_damaged_is_named_in_one_line(here, capsys, spoil, words):
    write_raw(here)
    spoil(here / DRIVE)
    code, err = kitti.main(["raw", DRIVE, "root"]), capsys.readouterr().err
    assert code == 2 and len(complaint(err)) == 1 and "Traceback" not in err, err
    assert all(word in err for word in words), err
    assert not (here / "root").exists()                 # nothing is left


def test_a_folder_that_is_no_raw_drive_is_named_in_one_line(here, capsys):
    for name in ("gone", ".", "2011_09_26_drive_0013_extract"):
        words = f"{name} is no drive of KITTI's raw data"
        fails_with_one_line(kitti.main, ["raw", name, "root"], words, capsys)
    assert not any(here.iterdir())


def test_as_a_user_sees_it_in_a_read_only_place_of_foreign_letters_with_no_home_and_spawned_workers(tmp_path, weights):
    here = tmp_path / "o\u00f9 \u00e7a \u6f22"

    def user(*arguments):
        ran = subprocess.run([sys.executable, *map(str, arguments)], cwd=here, capture_output=True, timeout=300, stdin=subprocess.DEVNULL,
                             env={"PATH": os.environ.get("PATH", ""), "PYTHONPATH": str(HERE), "LC_ALL": "C"})
        return ran.returncode, ran.stdout.decode(), ran.stderr.decode()
    here.mkdir()
    assert user("-c", "import d3dlo") == (0, "", "") and not any(here.iterdir())            # importing is silent and writes nothing
    rewrite(SCAN, lambda b: b[:16 * 1000])(write_root(here / "bad"))
    code, out, err = user(HERE / "d3dlo.py", "eval", "--data", "bad", "--weights", weights)
    assert (code, out, len(complaint(err))) == (2, "", 1) and SCAN in complaint(err)[0]
    for folder in write_root(here / "data").rglob("*"):
        folder.chmod(0o555 if folder.is_dir() else 0o444)
    (here / "run.py").write_text(
        "import multiprocessing, sys, d3dlo\nif __name__ == '__main__':\n    multiprocessing.set_start_method('spawn')\n"
        f"    sys.exit(d3dlo.main(['eval', '--data', 'data', '--weights', {str(weights)!r}, '--out', 'o\u00f9']))\n", encoding="utf-8")
    code, out, err = user("run.py")
    assert code == 0 and not complaint(err) and [path.name for path in here.glob("o\u00f9/*.txt")] == ["00.txt"], err


def test_pictures_are_drawn_where_there_is_matplotlib(here, monkeypatch, capsys):
    T, arguments = d3dlo.accumulate(motion(generator(0), [1, 0.1, 0.1, 0.1, 0.1, 1], n=150)), ["gt.txt", "gt.txt", "--plot", "a.png"]
    metrics.write_poses("gt.txt", T)
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "matplotlib.figure", None)                       # as if it were not installed
        fails_with_one_line(metrics.main, arguments, "matplotlib", capsys)
    pytest.importorskip("matplotlib")
    drawn, picture = [], metrics.picture

    def remember(*size):
        drawn.append(picture(*size))
        return drawn[-1]
    monkeypatch.setattr(metrics, "picture", remember)
    assert metrics.main(arguments) == 0
    metrics.draw("b.png", {"11": (None, T)})                                        # without ground truth
    assert all(Path(name).read_bytes().startswith(b"\x89PNG") for name in ("a.png", "b.png"))
    assert [len(figure.axes) for figure in drawn] == [3, 1]    # no errors, one axis
    for figure in drawn:                                # the poses are a LiDAR's: x forward, y left
        above = figure.axes[0]
        assert_allclose(above.lines[-2].get_xydata(), np.c_[-T[:, 1, 3], T[:, 0, 3]], atol=1e-6)
        assert above.get_ylabel() == "LiDAR x, forward [m]"
        assert all(axis.get_xlabel() and axis.get_ylabel() for axis in figure.axes)


# --------------------------------------------------------------------- the paper's experiments

experiments = SimpleNamespace(**runpy.run_path(str(HERE / "benchmarks" / "experiments.py")))
TWO_BALLS = replace(SMALL, sa1=Layer(2.0, 32, 12, (4, 8, 16)))  # 12 within 2 m, 3 within 1 m
REJECTED = {"quaternion": (experiments.Quaternion, SMALL),
            "coordinates": (experiments.Coordinates, SMALL),
            "two scales": (experiments.TwoScales, TWO_BALLS)}


@table("network, parameters", {
    "quaternion": (experiments.Quaternion, 61290 + 65),
    "coordinates": (experiments.Coordinates, 61290 + 3 * 64),
    "two scales": (experiments.TwoScales, 61290 + 868 + 2 * 32 * 32)})  # SA1 twice, a wider FE
def test_parameters_of_the_rejected_networks(network, parameters):
    for config in (Config(), Config(**experiments.TWO_SCALES)):  # neighbours do not matter
        assert count(network(config)) == parameters


@table("network, config", REJECTED)
@pytest.mark.parametrize("training", [True, False])
@given(seed=SEED)
@settings(max_examples=10)
def test_the_fast_twin_of_a_rejected_network_equals_the_plain_one(training, network, config, seed):
    rng = generator(seed)
    net = a_net(rng, config, network).double()
    plain, fast = copy.deepcopy(net).train(training), d3dlo.fast(net).train(training)
    batch = in_double(a_batch(rng, config)[0])
    expected, got = plain(batch), fast(batch)
    torch.testing.assert_close(got, expected, rtol=1e-9, atol=1e-9)
    assert got.std(0).max() > 1e-3  # the predictions differ from pair to pair
    weights = torch.from_numpy(rng.normal(size=expected.shape))
    names, parameters = zip(*net.named_parameters())  # shared by net and fast
    expected = torch.autograd.grad((expected * weights).sum(), [*plain.parameters()])
    got = torch.autograd.grad((got * weights).sum(), parameters)
    expected, got = dict(zip(names, expected)), dict(zip(names, got))
    torch.testing.assert_close(got, expected, rtol=1e-6, atol=1e-8)
    expected, got = dict(plain.state_dict()), dict(net.state_dict())  # running statistics too
    torch.testing.assert_close(got, expected, rtol=1e-9, atol=1e-9)
    slow = {d3dlo.MiniPointNet, d3dlo.SetAbstraction, d3dlo.FlowEmbedding}
    assert not slow & {type(module) for module in fast.modules()}


@given(SEED, st.sampled_from([200, 600, 3000]))
def test_two_scales_group_both_balls_as_group_ball_does(seed, N):
    rng = generator(seed)
    scan, mpn = cloud(rng, N), a_net(rng, TWO_BALLS, experiments.TwoScales).sa1.mpn
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
    net, batch = a_net(rng, SMALL, experiments.Coordinates), a_batch(rng)[0]
    seen = {}
    net.sa3.sa.register_forward_hook(lambda module, inputs, output: seen.update(sa3=output))
    net.mpn.register_forward_pre_hook(lambda module, inputs: seen.update(mpn=inputs[0]))
    net(batch)
    expected = torch.cat([seen["sa3"], batch.xyz[batch.p][:, :8] / 10], -1)
    torch.testing.assert_close(seen["mpn"], expected, rtol=0, atol=0)


@given(SEED)
def test_only_with_coordinates_does_the_prediction_depend_on_where_both_scans_are(seed):
    rng = generator(seed)
    batch = in_double(a_batch(rng)[0])
    elsewhere = batch._replace(xyz=batch.xyz + torch.tensor([20.0, -10.0, 0.0]))
    with torch.no_grad():
        table_1, coordinates = (
            (net(elsewhere) - net(batch)).abs().max()
            for net in (a_net(rng, SMALL, n).double() for n in (D3DLO, experiments.Coordinates)))
    assert table_1 < 1e-9 and coordinates > 1e-3


def l1(y_hat, y):
    return np.mean(np.abs(y_hat - y))


def eq_5(y_hat, y):
    """Mean over the pairs; a length below 0.001 counts as 0.001."""
    lengths = [np.maximum(np.linalg.norm(part, axis=1), 1e-3) for part in (y_hat, y)]
    return np.mean(1 - np.sum(y_hat * y, 1) / lengths[0] / lengths[1])


def uncertainty(y_hat, y, s_t, s_r):
    t, r = slice(None, 3), slice(3, None)
    weighted = l1(y_hat[:, t], y[:, t]) * np.exp(-s_t) + l1(y_hat[:, r], y[:, r]) * np.exp(-s_r)
    return weighted + s_t + s_r


@table("experiment, name, definition", {f"{experiment}: {name}": (experiment, name, definition)
                                        for experiment, name, definition in [
    ("loss", "eq. 2", l1),
    ("loss", "eq. 2 + eq. 5", lambda y_hat, y: l1(y_hat, y) + eq_5(y_hat, y)),
    ("loss", "eq. 2 + 0.1 eq. 5", lambda y_hat, y: l1(y_hat, y) + 0.1 * eq_5(y_hat, y)),
    ("loss", "eq. 2 + eq. 5 of the translation",
     lambda y_hat, y: l1(y_hat, y) + eq_5(y_hat[:, :3], y[:, :3])),
    ("loss", "uncertainty weighting", uncertainty),
    ("output", "quaternion", l1),
    ("output", "quaternion, uncertainty weighting", uncertainty)]})
@given(seed=SEED, speed=st.sampled_from([0, 1]), prediction=st.sampled_from([-1, 0, 1e-4, 1]),
       noise=st.sampled_from([0, 1]))
def test_every_loss_follows_its_definition_and_has_finite_gradients(
        experiment, name, definition, seed, speed, prediction, noise):
    rng, variant = generator(seed), experiments.EXPERIMENTS[experiment][name]
    y = variant.network.encode(motion(rng, speed, n=5))  # standing still, or moving
    y_hat = prediction * y + noise * rng.normal(size=y.shape)  # also opposite, equal
    objective = variant.objective().double()
    learned = [float(x) for w in objective.parameters() for x in w.data.normal_()]
    of_y_hat = torch.from_numpy(y_hat).requires_grad_()
    loss = objective(of_y_hat, torch.from_numpy(y))
    if variant.network is experiments.Quaternion:  # q and -q are the same rotation
        other = y * [1, 1, 1, -1, -1, -1, -1]
        y = np.stack([min(a, b, key=lambda t: np.linalg.norm(t - p))
                      for a, b, p in zip(y, other, y_hat)])
    assert_allclose(loss.item(), definition(y_hat, y, *learned), rtol=1e-9, atol=1e-9)
    gradients = torch.autograd.grad(loss, [of_y_hat, *objective.parameters()])
    assert all(gradient.isfinite().all() for gradient in gradients)


@given(SEED)
def test_quaternions_survive_the_round_trip_and_minus_q_is_the_same_rotation(seed):
    T, network = motion(generator(seed), (2, 1, 1, 60, 30, 60), n=4), experiments.Quaternion
    y = network.encode(T)
    assert_allclose(np.linalg.norm(y[:, 3:], axis=1), 1, atol=1e-12)
    for same in (y, y * ([1] * 3 + [-1] * 4)):
        assert_allclose(network.decode(same), T, atol=1e-9)


@given(SEED)
def test_a_predicted_quaternion_has_length_one_and_its_sign_does_not_matter_to_the_loss(seed):
    rng = generator(seed)
    net, (batch, T) = a_net(rng, SMALL, experiments.Quaternion), a_batch(rng)
    y_hat, y = net(batch), torch.from_numpy(net.encode(T)).float()
    torch.testing.assert_close(y_hat[:, 3:].norm(dim=1), torch.ones(len(y)))
    loss = experiments.QuaternionLoss(d3dlo.UnweightedLoss())
    minus = torch.tensor([1.0, 1, 1, -1, -1, -1, -1])
    torch.testing.assert_close(loss(y_hat * minus, y), loss(y_hat, y))
    torch.testing.assert_close(loss(y_hat, y * minus), loss(y_hat, y))


@pytest.mark.parametrize("experiment", experiments.EXPERIMENTS)
def test_the_runs_of_a_table_differ_and_have_the_same_number_of_pair_steps(experiment):
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


def test_tables_share_their_runs_and_other_data_or_budgets_make_new_ones(tmp_path):
    def folders(budget=1500, data="data"):
        plan = experiments.plan(experiments.EXPERIMENTS, 100, budget, [0], tmp_path, data)
        return {experiment: [run.folder for runs in rows.values() for run in runs]
                for experiment, rows in plan.items()}
    runs = folders()
    assert runs == folders()
    of_table_3 = runs.pop("table3")
    assert len({folders[0] for folders in runs.values()}) == 1  # Table 1 with eq. 2
    assert of_table_3[0] == runs["table2"][0] and set(of_table_3) < set(runs["table2"])
    for other in (folders(budget=3000), folders(data="other")):
        assert not set(sum(runs.values(), [])) & set(sum(other.values(), []))


IDENTITY = b"1 0 0 0 0 1 0 0 0 0 1 0\n"


@table("change", {  # what is done to the data
    "a scan is longer": rewrite(SCAN, lambda data: data + data[:16]),
    "a scan is written again": lambda root: os.utime(root / SCAN, (1, 1)),
    "a pose is added and one removed":
        rewrite(POSES, lambda data: data.partition(b"\n")[2] + IDENTITY),
    "another calibration":
        rewrite(CALIB, lambda data: data.partition(b"Tr:")[0] + b"Tr: " + IDENTITY)})
def test_the_fingerprint_changes_with_the_data_and_not_with_the_place(tmp_path, change):
    def fingerprint(root):
        return experiments.fingerprint(*kitti.open_sequences(root))
    root = write_root(tmp_path / "root")
    copied = shutil.copytree(root, tmp_path / "copy")
    assert fingerprint(copied) == fingerprint(root)
    change(copied)
    assert fingerprint(copied) != fingerprint(root)


@table("network, config", REJECTED)
def test_a_rejected_network_is_trained_stored_loaded_resumed_and_evaluated(here, network, config):
    write_root(here / "root")
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
        load_weights("run")  # another network
    stored = torch.load("run/checkpoint.pt", weights_only=True)["objective"]
    assert len(stored) == 1 and all(w.abs().min() > 0 for w in stored.values())  # it started at 0
    for w in objective.parameters():
        w.data.zero_()
    d3dlo.train(out="run", resume=True, network=network, objective=objective)
    for name, tensor in objective.state_dict().items():
        assert torch.equal(tensor, stored[name])
    assert torch.equal(net.mlp[-1].weight, load_weights("run", network)[0].mlp[-1].weight)
    d3dlo.evaluate("root", "run", out="results", network=network)
    results = json.loads((here / "results" / "results.json").read_text())
    assert results["sequences"]["00"]["trained_on"] and results["pooled"]["t_step_m"] > 0


# ------------------------------------------------------------------------------------------------------------- the readme

def test_the_python_of_the_documentation_runs_and_its_commands_parse(here, monkeypatch):
    def parse_only(parser, arguments=None, parse=argparse.ArgumentParser.parse_args):
        parse(parser, arguments)  # SystemExit(2) when it does not like them
        raise SystemExit("parsed")
    pages = [HERE / "README.md", *sorted(HERE.glob("docs/*.md"))]
    text = "\n".join(page.read_text(encoding="utf-8") for page in pages)
    for block in re.findall(r"```python\n(.*?)```", text, re.S):
        exec(compile(block, "a page", "exec"), {})
    commands = re.findall(r"^(?:pip install \S+ && )?python (\S+\.py)([^#\n]*)", text, re.M)
    commands += re.findall(r"`python (\S+\.py)([^`]*)`", text)
    assert len(commands) > 20
    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parse_only)
    for script, arguments in commands:
        monkeypatch.setattr(sys, "argv", [script, *arguments.split()])
        with pytest.raises(SystemExit, match="parsed"):
            runpy.run_path(str(HERE / script), run_name="__main__")
