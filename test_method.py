"""Tests of the method: sampling, network, training, odometry. Expected values never come from the
code under test. They come from brute force, SciPy, a definition written out, or a closed form.
"""
import contextlib
import copy
import itertools
import os
import re
import runpy
import warnings
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation
from torch.optim.swa_utils import update_bn

import d3dlo
import kitti
import metrics
from d3dlo import D3DLO, Config, Layer, load_weights, scan_records
from kitti import from_vector, to_vector

settings.register_profile(
    "d3dlo", deadline=None, derandomize=True, database=None, max_examples=25,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
settings.load_profile("d3dlo")

KITTI = Path(os.environ.get("D3DLO_KITTI", "no folder")).resolve()  # real data, optional
SEED = st.integers(0, 2**32 - 1)
generator, inverse = np.random.default_rng, np.linalg.inv

# A network with every kind of layer and a hundredth of the work
SMALL = Config(sa1=Layer(2.0, 16, 4, (4, 8, 16)), fe=Layer(None, None, 6, (16, 32)),
               sa2=Layer(4.0, 8, 8, (32, 32)), sa3=Layer(8.0, 4, 4, (32, 32)),
               mpn=Layer(None, None, None, (32, 64)), mlp=Layer(None, None, None, (32, 6)),
               max_range=50.0, swap="both")
# The paper's training, and one with everything that has a state: nine steps on `two_sequences`
PAPERS = replace(SMALL, epochs=3, batch=3, swap="random")
OURS = replace(SMALL, epochs=3, batch=3, augment=True, optimizer="muon", schedule="one-cycle",
               frozen=4 / 9)
# What a weights file stores about its training data. These ranges fit any scan.
FACTS = dict(trained_on=[], mean_motion=[1.0, 0, 0, 0, 0, 0],
             seen=[[1.0, 0.1, 1.0, 0.01], [1e6, 1e3, 100.0, 1.0]])


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


def transform(T, xyz):
    """Apply a rigid motion T (4,4) to points (...,3)."""
    return xyz @ T[:3, :3].T + T[:3, 3]


def static_world(rng, motions, points=100):
    """Scans of the same points from poses `motions` apart. The intensity is the scan's number."""
    world, scans = random_scan(rng, points)[:, :3].astype(float), []
    for i, T in enumerate(itertools.accumulate(motions, np.matmul, initial=np.eye(4))):
        scans.append(np.c_[transform(inverse(T), world), np.full(points, i)].astype(np.float32))
    return scans


def records_of(scans, config=SMALL):
    """The records (n,) of n scans, each sampled once."""
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


def in_double(batch):
    return batch._replace(xyz=batch.xyz.double(), group_sa1=batch.group_sa1.double())


def batch_norms(net):
    return [module for module in net.modules() if isinstance(module, torch.nn.BatchNorm1d)]


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


def save_weights(path, net, **facts):
    """Write a weights file as `fit` does. Returns its path."""
    config = net.config.as_dict()
    d3dlo.save(path, config=config, model=net.state_dict(), step=0, **FACTS | facts)
    return path


def train(folder, config, checkpoint=None, say=None, network=D3DLO, data=None, **options):
    """Run `fit`, on `two_sequences()` by default. Returns the lines it says."""
    lines = []
    torch.manual_seed(99 if checkpoint else 0)  # a resumed run must not depend on its first weights
    d3dlo.fit(network(config), data or two_sequences(), folder, seed=7, checkpoint=checkpoint,
              say=say or lines.append, **FACTS | options)
    return lines


def stored(path):
    return torch.load(path, weights_only=True)


def identical(a, b):
    """Whether the contents of two files are equal bit for bit."""
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(identical(a[key], b[key]) for key in a)
    if isinstance(a, (list, tuple)):
        return len(a) == len(b) and all(map(identical, a, b))
    return torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b


def assert_same_run(a, b):
    """Assert that two finished training runs have the same weights and the same last checkpoint."""
    for name in ("weights.pt", "checkpoint.pt"):
        assert identical(stored(a / name), stored(b / name)), name


# ------------------------------------------------------------------------------------------------
# Sampling and grouping

KINDS = st.sampled_from(["grid", "duplicates", "line", "one x", "far away", "float32", "float64"])


def random_points(rng, kind, N):
    """Points (N,3) of one of the KINDS, many of them with ties between distances."""
    xyz = rng.normal(size=(N, 3)) * [20, 20, 2]
    if kind == "grid":
        xyz = rng.integers(-4, 5, (N, 3))
    if kind == "duplicates":
        xyz = xyz[rng.integers(max(N // 3, 1), size=N)]
    if kind == "line":
        xyz[:, 1:] = 0
    if kind == "one x":
        xyz[:, 0] = 3
    if kind == "far away":  # coordinates are rounded to multiples of 6 cm
        xyz += 1e6
    return xyz.astype("float64" if kind == "float64" else "float32")


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
    assert got.dtype == np.int64


@pytest.mark.parametrize("N, n", [(5, 6), (5, 0), (5, -1), (0, 1), (1023, 1024)])
def test_farthest_point_sampling_refuses_no_samples_or_more_than_there_are_points(N, n):
    with pytest.raises(ValueError, match=f"{n} .*{N}"):
        d3dlo.farthest_point_sampling(np.zeros((N, 3), np.float32), n)


def nearest(xyz, query, k, r=np.inf, fill=None):
    """(S,k) indices by brute force: the k nearest points within r of each query, nearest first.

    Other places hold fill (S,), by default the nearest point.
    """
    rows = []
    for s, distance in enumerate(cdist(query.astype(float), xyz.astype(float))):
        row = [i for i in distance.argsort(kind="stable")[:k] if distance[i] <= r]
        rows.append(row + [row[0] if fill is None else fill[s]] * (k - len(row)))
    return np.array(rows)


def assert_same_neighbours(xyz, query, got, expected, atol=1e-6):
    """Assert that neighbours have the same distances. Of equally distant points, any is right."""
    D = cdist(query.astype(float), xyz.astype(float))
    assert got.shape == expected.shape
    assert_allclose(*(np.take_along_axis(D, idx, 1) for idx in (got, expected)), atol=atol)
    assert [len(set(row)) for row in got.tolist()] == [len(set(row)) for row in expected.tolist()]


@given(SEED, KINDS, st.integers(1, 300), st.integers(1, 12), st.sampled_from([0.5, 1.0, 2.0, 5.0]))
@settings(max_examples=60)
def test_group_ball_equals_brute_force(seed, kind, N, n_n, r):
    rng = generator(seed)
    xyz, centroids = random_points(rng, kind, N), rng.integers(N, size=20)
    got = d3dlo.group_ball(xyz, centroids, r, n_n)
    # In the grid, distances of exactly r occur
    expected = nearest(xyz, xyz[centroids], n_n, r, fill=centroids)
    assert_same_neighbours(xyz, xyz[centroids], got, expected)


class Elsewhere(torch.Tensor):
    """A tensor that claims not to be on the CPU."""

    device = SimpleNamespace(type="elsewhere")


@given(SEED, KINDS, st.integers(1, 60), st.integers(1, 70))
@settings(max_examples=60)
def test_group_knn_and_neighbours_in_q_equal_brute_force(seed, kind, N, k):
    rng = generator(seed)
    xyz, query = random_points(rng, kind, N), random_points(rng, kind, 20)
    assert_same_neighbours(xyz, query, d3dlo.group_knn(xyz, query, k), nearest(xyz, query, k))
    clouds, p, q = np.stack([xyz, xyz[::-1] + 1, -xyz]), np.array([2, 0, 0]), np.array([1, 2, 1])
    cpu = torch.from_numpy(clouds)
    for tensor in (cpu, cpu.as_subclass(Elsewhere)):
        for i, j, idx in zip(p, q, d3dlo.neighbours_in_q(tensor, p, q, k).numpy(), strict=True):
            expected = nearest(clouds[j], clouds[i], k)
            assert_same_neighbours(clouds[j], clouds[i], idx, expected, 1e-4)
            assert_array_equal(idx[:, N:], idx[:, :1].repeat(max(k - N, 0), 1))


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
        assert_array_equal(record["xyz"], xyz)
        neighbours = usable[nearest(usable[:, :3], xyz, 4, 2.0, centroids)]  # in the whole scan
        offsets = neighbours[..., :3] - xyz[:, None]
        assert_array_equal(record["group_sa1"], np.concatenate([neighbours[..., 3:], offsets], -1))
        assert_array_equal(record["idx_sa2"], nearest(xyz, xyz[:8], 8, 4.0, range(8)))
        assert_array_equal(record["idx_sa3"], nearest(xyz[:8], xyz[:4], 4, 8.0, range(4)))
        z, distances = usable[:, 2], np.sqrt(np.square(xyz).sum(1))
        fullest = max(((z >= low) & (z < low + 0.3)).sum() for low in np.arange(-10, 10) * 0.3)
        expected = points, usable[:, 3].mean(), np.median(distances), fullest / points
        assert_allclose(record["stats"], expected, rtol=1e-4)
        assert record["invalid"] == 6
    centroids = np.concatenate(records["xyz"][:parts])
    assert len(records) == n and len(np.unique(centroids, axis=0)) == 16 * parts  # none shared
    too_few = np.concatenate([usable[:15], junk])
    with pytest.raises(ValueError, match="15 usable points .* 50 m.* needs 16"):
        scan_records(too_few, SMALL, n)


@pytest.mark.skipif(not KITTI.is_dir(), reason="D3DLO_KITTI names no folder")
def test_real_scans_are_sampled_by_the_definition_and_lose_their_ground():
    for s in kitti.open_sequences(KITTI):
        scan = s.scan(len(s) // 2)
        expected = fps_by_definition(scan[:, :3], 128)
        assert_array_equal(d3dlo.farthest_point_sampling(scan[:, :3], 128), expected)
        assert 0.25 < 1 - len(kitti.remove_plane(scan)) / len(scan) < 0.65


# ------------------------------------------------------------------------------------------------
# Motions and frames


def motion_by_definition(v):
    """x, y, z [m], roll, pitch, yaw [degrees] as a matrix (4,4), written out."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(np.radians(v[3:])), np.sin(np.radians(v[3:]))
    Rx = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    Ry = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    Rz = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return np.block([[Rz @ Ry @ Rx, np.array(v[:3])[:, None]], [np.zeros(3), 1]])


@given(SEED, st.lists(st.integers(0, 5), max_size=3))
@settings(max_examples=60)
def test_vectors_of_any_leading_shape_are_extrinsic_xyz_and_survive_the_round_trip(seed, shape):
    v = generator(seed).uniform(-1, 1, (*shape, 6)) * [100, 100, 100, 179.9, 89, 179.9]
    T = from_vector(v)
    expected = [motion_by_definition(row) for row in v.reshape(-1, 6)]
    assert_allclose(T, np.reshape(expected, (*shape, 4, 4)), atol=1e-12)
    assert_allclose(to_vector(T), v, atol=1e-7)
    assert_allclose(kitti.invert(T), inverse(T), atol=1e-11)


@given(SEED, st.sampled_from([90, -90]), st.sampled_from([0, 1e-12, 1e-9, 1e-7, 1e-5, 1e-3, 0.1]))
@settings(max_examples=100)
def test_motions_survive_the_round_trip_at_gimbal_lock_without_a_warning(seed, pole, off):
    roll, yaw = generator(seed).uniform(-179.9, 179.9, 2)
    T = motion_by_definition([1, 2, 3, roll, pole - np.sign(pole) * off, yaw])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert_allclose(from_vector(to_vector(T)), T, atol=1e-6)


@given(SEED)
def test_camera_and_velodyne_motions_move_a_point_to_the_same_place(seed):
    rng = generator(seed)
    T, Tr = random_motion(rng, [5, 5, 5, 60, 60, 60]), random_motion(rng, [1, 1, 1, 90, 60, 90])
    T_cam, q = kitti.velo_to_camera(T, Tr), rng.normal(size=(10, 3))
    # Change the frame, then move; or move, then change the frame
    assert_allclose(transform(T_cam @ Tr, q), transform(Tr, transform(T, q)), atol=1e-12)
    assert_allclose(kitti.camera_to_velo(T_cam, Tr), T, atol=1e-12)


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
    layers = [torch.nn.Linear, torch.nn.BatchNorm1d, torch.nn.ReLU]
    assert [type(layer) for layer in net.mlp] == [*layers, torch.nn.Linear]
    for h, depth in ((net.sa1.mpn.h, 4), (net.fe.mpn.h, 2), (net.sa2.mpn.h, 2), (net.mpn.h, 2)):
        assert [type(layer) for layer in h] == layers * depth


def test_the_default_config_is_that_of_the_paper():
    table_1 = {"sa1": Layer(1.0, 1024, 8, (4, 8, 16, 32)), "fe": Layer(None, None, 16, (32, 64)),
               "sa2": Layer(4.0, 256, 32, (64, 64)), "sa3": Layer(8.0, 64, 8, (64, 64)),
               "mpn": Layer(None, None, None, (64, 256)), "mlp": Layer(None, None, None, (64, 6))}
    section_4 = dict(epochs=500, optimizer="adam", schedule="steps", swap="random", max_range=None,
                     plane=True, augment=False, frozen=0)
    default = vars(Config())
    assert table_1.items() | section_4.items() <= default.items()
    assert default.keys() - (table_1 | section_4).keys() == {"batch", "lr"}  # not in the paper
    adam, = d3dlo.make_optimizers(D3DLO(), d3dlo.MeanAbsoluteError())
    assert type(adam) is torch.optim.Adam
    assert adam.defaults == torch.optim.Adam([torch.zeros(1)]).defaults  # "with default values"


def by_the_equations(net, batch):
    """The predictions by eqs. 3 and 4 as they are printed, with loops over pairs and points."""
    xyz, P, Q = batch.xyz, batch.p.tolist(), batch.q.tolist()

    def maximum(mpn, groups):
        """max h over each group of points: S lists of k vectors (c,) -> (S,c')."""
        z = torch.stack([torch.stack(tuple(group)) for group in groups])  # (S,k,c)
        return mpn.h(z.flatten(0, 1)).unflatten(0, z.shape[:2]).max(1).values

    def eq_3(sa, x, f, idx):
        groups = [[torch.cat([f[b][i], x[b][i] - x[b][j]]) for i in idx[b][j].tolist()]
                  for b in range(len(P)) for j in range(len(idx[b]))]
        return maximum(sa.mpn, groups).unflatten(0, (len(P), -1))

    def eq_4(fe, f):
        groups = [[torch.cat([f[p][i], f[q][j], xyz[q][j] - xyz[p][i]]) for j in neighbours]
                  for p, q in zip(P, Q) for i, neighbours in
                  enumerate(nearest(xyz[q].numpy(), xyz[p].numpy(), net.config.fe.n_n))]
        return maximum(fe.mpn, groups).unflatten(0, (len(P), -1))

    # The groups of the first set abstraction hold f_i and x_i - x'_j already
    f = maximum(net.sa1.mpn, batch.group_sa1.flatten(0, 1)).unflatten(0, (len(xyz), -1))
    e = eq_4(net.fe, f)
    e = eq_3(net.sa2, xyz[P], e, batch.idx_sa2[P])
    e = eq_3(net.sa3, xyz[P], e, batch.idx_sa3[P])
    return net.mlp(maximum(net.mpn, e))


CONFIGS = {
    "small": SMALL,
    "one neighbour": replace(SMALL, sa1=SMALL.sa1._replace(n_n=1), fe=SMALL.fe._replace(n_n=1),
                             sa2=SMALL.sa2._replace(n_n=1)),
    # All neighbours are copies of the centroid, so every maximum is a tie
    "centroids alone": replace(SMALL, swap="random", sa3=SMALL.sa3._replace(r=0.1)),
    "more neighbours than points": replace(SMALL, fe=SMALL.fe._replace(n_n=20),
                                           sa3=SMALL.sa3._replace(n_n=12))}


@table("config", CONFIGS)
@pytest.mark.parametrize("training", [True, False])
@given(seed=SEED)
@settings(max_examples=3)
def test_predictions_gradients_and_statistics_follow_equations_3_and_4(training, config, seed):
    rng = generator(seed)
    net, batch = random_net(rng, config).double().train(training), random_batch(rng, config, 2)[0]
    literal, batch = copy.deepcopy(net), in_double(batch)
    got, expected = net(batch), by_the_equations(literal, batch)
    assert expected.std(0).min() > 1e-3  # predictions of different pairs differ
    torch.testing.assert_close(got, expected, rtol=1e-9, atol=1e-9)
    for y in (got, expected):
        (y * torch.arange(y.numel()).view(y.shape)).sum().backward()
    gradients = [{name: p.grad for name, p in n.named_parameters()} for n in (net, literal)]
    torch.testing.assert_close(*gradients, rtol=1e-6, atol=1e-7)
    torch.testing.assert_close(net.state_dict(), literal.state_dict(), rtol=1e-9, atol=1e-9)


class OnlyOnMeta(torch.utils._python_dispatch.TorchDispatchMode):
    """Fail if an operation returns a tensor on another device."""

    def __torch_dispatch__(self, function, types, arguments=(), options=None):
        result = function(*arguments, **options or {})
        for tensor in torch.utils._pytree.tree_leaves(result):
            assert not isinstance(tensor, torch.Tensor) or tensor.is_meta, function
        return result


@pytest.mark.parametrize("training", [True, False])
def test_all_tensors_are_made_on_the_device_of_the_input(training):
    records = records_of(random_scan(generator(0), 64) for _ in range(6))
    batch = d3dlo.make_batch(records, np.array([0, 2, 5]), np.array([1, 3, 4]), SMALL, "meta")
    net = D3DLO(SMALL).to("meta").train(training)
    assert all(part.is_meta for part in batch) and batch.idx_fe.shape == (3, 16, 6)
    with OnlyOnMeta():
        y_hat = net(batch)
        d3dlo.MeanAbsoluteError()(y_hat, torch.empty_like(y_hat)).backward()
    assert y_hat.shape == (3, 6) and net.sa1.mpn.h[0].weight.grad.is_meta


# ------------------------------------------------------------------------------------------------
# Training data


@given(SEED, st.sampled_from(["both", "random"]), st.booleans(), st.integers(2, 12))
@settings(max_examples=15)
def test_batches_depend_on_seed_and_step_alone(seed, swap, augmented, batch):
    config, data = replace(SMALL, swap=swap, augment=augmented, batch=batch), two_sequences()

    def bytes_of_batches(seed, start, stop):
        return [b"".join(np.asarray(part).tobytes() for part in (*batch, T))
                for batch, T in d3dlo.batches(data, config, (seed,), start, stop)]

    steps = 2 * d3dlo.steps_per_epoch(10, config)  # two epochs
    whole = bytes_of_batches(seed, 0, steps)
    assert len(set(whole)) == steps
    for start in (1, steps // 2, steps - 1):
        assert bytes_of_batches(seed, start, steps) == whole[start:]
    assert bytes_of_batches(seed + 1, 0, 1) != whole[:1]


@given(SEED, st.sampled_from(["both", "random"]), st.integers(2, 12))
def test_an_epoch_has_every_pair_once_with_the_motion_in_its_direction(seed, swap, batch):
    config, data = replace(SMALL, swap=swap, batch=batch), two_sequences()
    scan_of = {record["xyz"].tobytes(): (s, i) for s, (records, _) in enumerate(data)
               for i, record in enumerate(records)}
    seen, steps = [], d3dlo.steps_per_epoch(10, config)
    for b, T_pq in d3dlo.batches(data, config, (seed,), 0, steps):
        assert len(T_pq) >= min(batch, 10)  # no smaller batch at the end
        for p, q, T in zip(b.p, b.q, T_pq, strict=True):
            (s, i), (s_q, j) = (scan_of[b.xyz[c].numpy().tobytes()] for c in (p, q))
            assert s == s_q and abs(i - j) == 1
            motion = data[s][1][min(i, j)]
            assert_allclose(T, motion if i < j else inverse(motion), atol=1e-9)
            seen.append((s, min(i, j), i < j))
        if swap == "both":  # both directions are in one batch
            assert 2 * len({pair[:2] for pair in seen}) == len(seen)
    assert {pair[:2] for pair in seen} == {(s, i) for s in range(2) for i in range(5)}
    assert len(seen) == len(set(seen)) == (20 if swap == "both" else 10)


def test_the_direction_of_a_pair_is_random():
    examples = d3dlo.batches(two_sequences(), replace(PAPERS, batch=10), (0,), 0, 40)
    forward = np.array([(batch.p < batch.q).numpy() for batch, _ in examples])  # (40,10)
    assert abs(forward.mean() - 0.5) < 0.1 and np.abs(forward.mean(0) - 0.5).max() < 0.35


@pytest.mark.parametrize("batch, pairs", [(1, 10), (16, 1)])
def test_batches_of_one_pair_in_one_direction_are_refused(batch, pairs):
    assert d3dlo.steps_per_epoch(pairs, replace(SMALL, swap="both", batch=batch)) == pairs
    with pytest.raises(ValueError, match="at least 2"):
        d3dlo.steps_per_epoch(pairs, replace(SMALL, swap="random", batch=batch))


def test_augmentation_aligns_a_third_of_the_pairs_mirrors_half_and_moves_q():
    rng, mirror = generator(0), np.diag([1, -1, 1, 1])
    step = motion_by_definition([1.2, 0, 0, 0, 0, 20])  # turns more than any residual motion
    data = [(records := records_of(static_world(rng, [step] * 30)), np.stack([step] * 30))]
    config, seen = replace(SMALL, augment=True), []
    for _ in range(40):
        batch, T = d3dlo.training_batch(data, [(0, i) for i in range(26)], config, rng)
        xyz, groups = batch.xyz.numpy(), batch.group_sa1.numpy()
        numbers = groups[:, 0, 0, 0].astype(int)  # the intensities, which nothing changes
        assert_array_equal(batch.idx_sa2, records["idx_sa2"][numbers])
        points = xyz[:, :, None] + groups[..., 1:]  # (C,n1,k1,3)
        for p, q, T_pq in zip(batch.p[:26], batch.q[:26], T):
            assert_allclose(transform(T_pq, xyz[q]), xyz[p], atol=1e-3)
            assert_allclose(transform(T_pq, points[q]), points[p], atol=1e-3)
            assert np.linalg.det(T_pq[:3, :3]) > 0.999  # no reflection is left
            side, = np.unique(np.sign(xyz[p, :, 1] * records["xyz"][numbers[p]][:, 1]))
            base = step if side > 0 else mirror @ step @ mirror
            is_aligned = abs(to_vector(T_pq)[5]) < 10
            A = to_vector(inverse(T_pq) @ (np.eye(4) if is_aligned else base))
            seen.append((numbers[q] - numbers[p], side, is_aligned, *A))
    gap, side, is_aligned, *A = np.transpose(seen)
    assert abs(is_aligned.mean() - 1 / 3) < 0.05 and abs(side.mean()) < 0.1
    for chosen in (is_aligned == 1, is_aligned == 0):  # Q moves after it has been aligned
        assert_allclose(np.mean(A, 1, where=chosen), 0, atol=0.2)
        assert_allclose(np.std(A, 1, where=chosen), [0.25, 0.1, 0.03, 0.1, 0.1, 1], rtol=0.15)
    assert set(gap[is_aligned == 0]) == {1} and set(gap) == {1, 2, 3, 4}  # 4.8 m at most


@given(SEED)
def test_a_later_scan_is_the_next_one_or_any_within_five_metres(seed):
    rng = generator(seed)
    motions, steps = np.tile(np.eye(4), (12, 1, 1)), rng.choice([0.5, 1, 2, 7], 12)
    motions[:, 0, 3], i = steps, int(rng.integers(12))
    within = {j for j in range(i + 1, 13) if steps[i:j].sum() < 5}
    assert {d3dlo.later_scan(motions, i, rng) for _ in range(300)} == within | {i + 1}


# ------------------------------------------------------------------------------------------------
# Training


def test_the_network_can_overfit_sixteen_pairs(tmp_path):
    data = pairs_of_scans(generator(0), 16)
    train(tmp_path, replace(SMALL, epochs=300, lr=1e-2, schedule="one-cycle", frozen=0.25),
          data=data)
    net, _ = load_weights(tmp_path)
    got = to_vector([d3dlo.predict_motions(net, records)[0] for records, _ in data])
    truth = to_vector([motions[0] for _, motions in data])
    assert np.abs(truth).mean() > 0.3 and np.abs(got - truth).mean() < 0.02


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


@contextlib.contextmanager
def interrupted(owner, name, n):
    """Raise KeyboardInterrupt at the end of the n-th call of a function."""
    calls, work = itertools.count(1), getattr(owner, name)

    def stop(*arguments, **options):
        if next(calls) < n:
            return work(*arguments, **options)
        if name == "save":  # in the middle of a file
            arguments[1].write(b"half of a file")
        else:
            work(*arguments, **options)
        raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(owner, name, stop)
        patch.setattr(d3dlo, "CHECKPOINT_EVERY", 0)  # after each step
        patch.setattr(d3dlo, "WEIGHTS_EVERY", 0)
        yield


class LearnedWeights(torch.nn.Module):
    """A loss with parameters of its own."""

    def __init__(self):
        super().__init__()
        self.weights = torch.nn.Parameter(torch.zeros(6))

    def forward(self, y_hat, y):
        return ((y - y_hat).abs() * self.weights.exp() + self.weights**2).mean()


@pytest.fixture(scope="module", params=[(OURS, LearnedWeights), (PAPERS, d3dlo.MeanAbsoluteError)],
                ids=["ours", "the paper's"])
def whole(request, tmp_path_factory):
    """An uninterrupted run: its config, class of loss, folder and lines."""
    (config, objective), folder = request.param, tmp_path_factory.mktemp("whole")
    return config, objective, folder, train(folder, config, objective=objective())


@given(n=st.integers(1, 18), place=st.sampled_from(["forward", "backward", "step", "save",
                                                    "replace"]))
@settings(max_examples=12)
def test_an_interrupted_run_leaves_complete_files_and_resumes_to_the_same_bits(
        tmp_path_factory, whole, n, place):
    (config, objective, folder, lines), part = whole, tmp_path_factory.mktemp("part")
    owner = dict(forward=objective, backward=torch.Tensor, step=torch.optim.Adam, save=torch,
                 replace=os)[place]
    done, said = (n - 1) // 2, []
    weights = checkpoint = done  # the last steps of which they are stored
    if place == "save":  # each step stores its weights, then a checkpoint
        weights = n // 2
    if place == "replace":
        weights, checkpoint = (n + 1) // 2, n // 2
    with interrupted(owner, place, n if place in ("save", "replace") else done + 1):
        train(part, config, say=said.append, objective=objective())
    expected = {"weights.pt": weights, "checkpoint.pt": checkpoint}
    assert {name: stored(part / name)["step"] for name in os.listdir(part)} == {
        name: step for name, step in expected.items() if step}
    assert not weights or load_weights(part)[1]["seen"] == FACTS["seen"]
    content = stored(part / "checkpoint.pt") if checkpoint else None
    said += train(part, config, content, objective=objective())
    assert list(dict.fromkeys(said)) == lines  # a line may be said twice
    assert_same_run(part, folder)
    # Resuming a finished run changes nothing
    assert train(part, config, stored(part / "checkpoint.pt"), objective=objective()) == []
    assert_same_run(part, folder)


class Diverges(d3dlo.MeanAbsoluteError):
    """Eq. 2, until the loss or its gradient is NaN in a given step."""

    def __init__(self, step, what):
        super().__init__()
        self.left, self.what = step, what

    def forward(self, y_hat, y):
        self.left -= y_hat.requires_grad  # the test loss has no gradient
        loss = super().forward(y_hat, y)
        if self.left == 0:
            loss = loss * np.nan if self.what == "loss" else loss + (0 * y_hat).sum().sqrt()
        return loss


@given(step=st.integers(1, 9), what=st.sampled_from(["loss", "gradient"]), tested=st.booleans(),
       every=st.sampled_from([0, 60]))
@settings(max_examples=16)
def test_a_run_that_diverges_says_so_and_keeps_the_last_good_files(
        tmp_path_factory, step, what, tested, every):
    folder, test = tmp_path_factory.mktemp("run"), two_sequences() if tested else ()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(d3dlo, "CHECKPOINT_EVERY", every)
        with pytest.raises(ValueError, match=r"\A\S+: [^\n]* non-finite at step [^\n]*\Z"):
            train(folder, PAPERS, objective=Diverges(step, what), test=test)
    assert os.listdir(folder) == ["checkpoint.pt"] * (step > 1 and every == 0)
    for path in folder.iterdir():
        content = stored(path)
        assert content["step"] == step - 1
        for x in torch.utils._pytree.tree_leaves(content):
            assert not isinstance(x, torch.Tensor) or x.isfinite().all()


@pytest.mark.parametrize("frozen, step", [(0, 6), (0.5, 3)])
def test_statistics_are_recomputed_at_the_end_or_when_they_are_frozen(tmp_path, frozen, step):
    # Each batch holds all ten pairs, so all batches have the same statistics
    config, data = replace(SMALL, epochs=6, batch=10, lr=1e-2, frozen=frozen), two_sequences()
    train(tmp_path, config)
    got = stored(tmp_path / "weights.pt")["model"]
    state, lagging = got, stored(tmp_path / "checkpoint.pt")["parts"][0]
    if frozen:
        with interrupted(d3dlo.MeanAbsoluteError, "forward", step + 1):
            train(tmp_path / "part", config)
        state = lagging = stored(tmp_path / "part" / "checkpoint.pt")["parts"][0]
    net = D3DLO(config).train()
    net.load_state_dict(state)
    for norm in batch_norms(net):
        norm.momentum = 1  # the statistics of the last batch alone
    net(d3dlo.training_batch(data, d3dlo.all_pairs(data), config, None)[0])
    names = [name for name in got if "running" in name]
    for name in names:
        torch.testing.assert_close(got[name], net.state_dict()[name], rtol=1e-3, atol=1e-3)
    assert max((got[name] - lagging[name]).abs().max() for name in names) > 0.05


def test_muon_trains_the_hidden_matrices_with_steps_as_large_as_adams():
    torch.manual_seed(0)
    net, objective = D3DLO(replace(SMALL, optimizer="muon")), LearnedWeights()
    adam, muon = d3dlo.make_optimizers(net, objective)
    matrices = [m.weight for m in net.modules() if isinstance(m, torch.nn.Linear)][:-1]
    others = {*net.parameters(), *objective.parameters()} - {*matrices}
    assert {*muon.param_groups[0]["params"]} == {*matrices}
    assert {*adam.param_groups[0]["params"]} == others
    before = [W.detach().clone() for W in matrices]
    for gradient in (torch.zeros_like, torch.randn_like):
        for W in matrices:
            W.grad = gradient(W)
        muon.step()
        steps = [(W - old).square().mean().sqrt() / net.config.lr
                 for W, old in zip(matrices, before)]
        if gradient is torch.zeros_like:
            assert max(steps) == 0  # no gradient, no step: no weight decay
    assert 0.1 < min(steps) < max(steps) < 0.3  # Adam's: 0.2 (Liu et al., "Muon is scalable")


def test_the_test_loss_is_that_of_the_weights_and_does_not_affect_training(tmp_path, whole):
    (config, objective, folder, lines), test = whole, pairs_of_scans(generator(1), 9)
    if objective is LearnedWeights:
        return
    said = train(tmp_path, config, test=test)
    assert_same_run(tmp_path, folder)
    pattern = r", test loss (\d\.\d{4})"
    assert [re.sub(pattern, "", line, count=1) for line in said] == lines
    net, errors = load_weights(tmp_path)[0], []
    for records, T in test:
        for pair, motion in ((records, T), (records[::-1], inverse(T))):
            errors.append(to_vector(d3dlo.predict_motions(net, pair)) - to_vector(motion))
    assert float(re.search(pattern, said[-1])[1]) == pytest.approx(np.abs(errors).mean(), abs=1e-4)


@given(st.integers(1, 800), st.integers(1, 800))
@settings(max_examples=5)
def test_the_test_loss_uses_at_most_500_pairs_spread_over_all_sequences(n, m):
    numbers = []

    def remember(y_hat, y):  # y is the number of the pair, negative in the other direction
        numbers.extend(y[:, 0].round().int().tolist())
        return torch.zeros(())

    motions = from_vector(np.arange(1, n + m + 1)[:, None] * [1, 0, 0, 0, 0, 0])
    records = np.zeros(n + m + 2, d3dlo.record_dtype(SMALL))
    data = [(records[:n + 1], motions[:n]), (records[n + 1:], motions[n:])]
    assert d3dlo.held_out_loss(D3DLO(SMALL).eval(), remember, data, "cpu") == 0
    chosen = sorted(abs(x) for x in numbers if x > 0)
    assert sorted(numbers) == sorted([*chosen, *(-x for x in chosen)])
    assert len({*chosen}) == len(chosen) == min(500, n + m)
    assert chosen[0] == 1 and chosen[-1] == n + m
    assert len(set(np.diff(chosen))) <= 2  # evenly spread
