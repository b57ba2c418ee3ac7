"""D3DLO: Deep 3D LiDAR Odometry (Adis, Horst, Wien; ICIP 2021), a reference implementation.

The network takes two consecutive LiDAR scans P and Q and predicts the rigid motion between them.
Read this file beside the paper, from top to bottom:

    1  Configuration            Table 1 and section 4
    2  Sampling and grouping    sections 3.3.2 and 3.3.3; NumPy, as nothing is learned here
    3  The network              section 3.3, eqs. 3 and 4, Fig. 1; PyTorch
    4  Training                 eq. 2 and section 4
    5  Weights files and devices
    6  Odometry                 eq. 1
    7  Evaluation               section 5
    8  Our additions            not in the paper: augmentation and refinement
    9  Faster versions of functions in parts 2 and 3. The code calls these, and they return the
       same results up to rounding. To understand the method, read parts 2 and 3.
    10 The commands train and eval

kitti.py converts motions to the vectors of section 3.2 (`to_vector`), removes the ground plane
(section 4), and loads or simulates the data. metrics.py computes E_t and E_r, eqs. 6 to 8. What
the paper tried and rejected (eq. 5, quaternions, uncertainty weighting, multi-scale grouping) is
in benchmarks/experiments.py. docs/paper-differences.md lists the differences from the paper.

Frame: Velodyne, x forward, y left, z up, in metres. T_ab maps points from frame b to frame a;
T_pq is the paper's T_{t,t+1}. Shapes: N points of a scan, S centroids, k neighbours, c features,
C scans in a batch, B pairs of them; n1 to n3 and k1 to k3 are n_fps and n_n of SA1 to SA3.

    python d3dlo.py train                       # on a simulated city; 15 minutes on a CPU
    python d3dlo.py train --data ROOT           # on KITTI odometry, with the paper's settings
    python d3dlo.py eval --data ROOT            # with the pretrained weights
"""
import argparse
import copy
import functools
import itertools
import json
import math
import os
import pickle
import sys
import time
import warnings
import zipfile
import zlib
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch import nn
from torch.optim.swa_utils import update_bn

import kitti
import metrics
from kitti import SPLITS, from_vector, invert, progress, to_vector

__version__ = "0.2.0"

# ------------------------------------------------------------------------------------------------
# 1  Configuration: Table 1 and section 4


class Layer(NamedTuple):
    """A row of Table 1."""

    r: float | None  # radius of the ball [m]
    n_fps: int | None  # number of centroids kept by farthest point sampling
    n_n: int | None  # number of neighbours (the maximum, for a ball)
    widths: tuple  # MLP: output width of every linear layer


@dataclass(frozen=True)
class Config:
    """Network, input and training. The defaults are the paper's wherever it gives a value."""

    # Table 1         r    n_fps  n_n   MLP
    sa1: Layer = Layer(1.0, 1024, 8, (4, 8, 16, 32))
    fe: Layer = Layer(None, None, 16, (32, 64))
    sa2: Layer = Layer(4.0, 256, 32, (64, 64))
    sa3: Layer = Layer(8.0, 64, 8, (64, 64))
    mpn: Layer = Layer(None, None, None, (64, 256))
    mlp: Layer = Layer(None, None, None, (64, 6))

    # Input
    max_range: float | None = None  # drop points farther away [m]; None keeps all valid points
    plane: bool = True  # keep the points of the ground plane, "pp" in Table 2

    # Training, section 4
    epochs: int = 500
    batch: int = 16  # pairs of scans in a batch, at least; the paper does not say
    optimizer: str = "adam"  # the paper's; or ours, "muon": Muon for the hidden layers
    lr: float = 1e-3  # learning rate: Adam's default; with "one-cycle" the peak
    schedule: str = "steps"  # lr / 10 (factor ours) after 3/5 and 4/5 of the steps; or "one-cycle"
    swap: str = "random"  # the paper's: one direction of each pair; or ours, "both"
    augment: bool = False  # ours: also mirror pairs and move Q by small random motions
    frozen: float = 0.0  # ours: share of the steps, at the end, with fixed BatchNorm statistics

    def __post_init__(self):
        # JSON turns a Layer into a list. Turn it back; a frozen dataclass needs object.__setattr__.
        for name in ("sa1", "fe", "sa2", "sa3", "mpn", "mlp"):
            *numbers, widths = getattr(self, name)
            object.__setattr__(self, name, Layer(*numbers, tuple(widths)))
        check_config(self)

    def as_dict(self):
        """A dict that JSON can hold. `Config(**d)` is the inverse."""
        return json.loads(json.dumps(asdict(self)))


def check_config(config):
    """Raise a ValueError that names the invalid setting."""
    def require(condition, message):
        if not condition:
            raise ValueError(f"Config: {message}")

    def whole(x, most=2**31):
        return type(x) is int and 1 <= x <= most

    def positive(x):
        return type(x) in (int, float) and 0 < x < math.inf

    sa1, fe, sa2, sa3, mlp = config.sa1, config.fe, config.sa2, config.sa3, config.mlp
    widths = [layer.widths for layer in (sa1, fe, sa2, sa3, config.mpn, mlp)]
    require(all(positive(sa.r) for sa in (sa1, sa2, sa3)), "every radius must be positive")
    require(all(whole(sa.n_fps, 65535) for sa in (sa1, sa2, sa3)), "n_fps must be 1 to 65,535")
    require(sa1.n_fps >= sa2.n_fps >= sa3.n_fps, "n_fps must not increase from layer to layer")
    require(all(whole(x.n_n, 1024) for x in (sa1, fe, sa2, sa3)), "n_n must be 1 to 1,024")
    require(all(len(w) > 1 and all(map(whole, w)) for w in widths), "an MLP needs 2 layers or more")
    require(mlp.widths[-1] == 6, "the last width of mlp must be 6: translation and angles")
    require(config.max_range is None or positive(config.max_range), "max_range must be positive")
    require(whole(config.epochs) and whole(config.batch), "epochs and batch must be 1 or more")
    require(positive(config.lr), "lr must be positive")
    require(config.frozen == 0 or positive(config.frozen) and config.frozen < 1,
            "frozen must be at least 0 and below 1")
    require(isinstance(config.plane, bool) and isinstance(config.augment, bool),
            "plane and augment must be True or False")
    require(config.optimizer in ("adam", "muon"), "optimizer must be adam or muon")
    require(config.schedule in ("steps", "one-cycle"), "schedule must be steps or one-cycle")
    require(config.swap in ("both", "random"), "swap must be both or random")


# The settings of training, as opposed to those of the network and its input
TRAINING = "epochs", "batch", "optimizer", "lr", "schedule", "swap", "augment", "frozen"
# Our short recipe: a quarter of an hour on the simulated city
SHORT = dict(max_range=50.0, epochs=9, batch=8, optimizer="muon", lr=1e-2, schedule="one-cycle",
             swap="both", augment=True, frozen=0.25)

# ------------------------------------------------------------------------------------------------
# 2  Sampling and grouping: sections 3.3.2 and 3.3.3


def fps_textbook(xyz, n, start=0):
    """Farthest point sampling: each new centroid is the point farthest from all centroids so far.

    xyz (N,3), index of the first centroid -> indices (n,) of the centroids. Ties go to the lowest
    index. The code uses `farthest_point_sampling`, which returns the same indices faster.
    """
    x, y, z = np.ascontiguousarray(xyz.T)
    min_dist = np.full(len(xyz), np.inf, xyz.dtype)  # squared distance to the nearest centroid
    centroids = np.full(n, start)  # all but the first are replaced
    for i in range(1, n):
        j = centroids[i - 1]
        dist = (x - x[j]) ** 2 + (y - y[j]) ** 2 + (z - z[j]) ** 2  # (N,)
        min_dist = np.minimum(min_dist, dist)
        centroids[i] = np.argmax(min_dist)
    return centroids


def group_ball(xyz: np.ndarray, centroids: np.ndarray, r: float, n_n: int, tree=None) -> np.ndarray:
    """The neighbours i of each centroid j in eq. 3: the nearest n_n points with |x_i - x'_j| <= r.

    xyz (N,3) in metres, centroids (S,) indices into xyz -> (S,n_n) indices, nearest first (the
    paper does not say which n_n points it takes). The first one is the centroid itself, or a point
    at the same place, so no ball is empty. Missing neighbours are filled with the centroid. These
    copies leave the maximum in eq. 3 unchanged but do affect the statistics of batch normalisation.
    tree: a cKDTree of xyz. None builds one.
    """
    ranks = [*range(1, n_n + 1)]  # a list keeps the result two-dimensional for n_n = 1
    inclusive = np.nextafter(r, np.inf)  # scipy's bound is exclusive
    _, idx = (tree or cKDTree(xyz)).query(xyz[centroids], ranks, distance_upper_bound=inclusive)
    return np.where(idx < len(xyz), idx, centroids[:, None])  # scipy returns N if missing


def group_knn(xyz: np.ndarray, query: np.ndarray, k: int) -> np.ndarray:
    """The neighbours j of each point i in eq. 4: the k nearest, not those in a ball.

    xyz (N,3), query (S,3) -> (S,k) indices into xyz, nearest first. The nearest is repeated when
    xyz has fewer than k points.
    """
    _, idx = cKDTree(xyz).query(query, [*range(1, k + 1)])
    return np.where(idx < len(xyz), idx, idx[:, :1])


def geometry_dtype(config):
    """The dtype of a scan's record: the network's input, and statistics of the scan."""
    n1, n2, n3 = config.sa1.n_fps, config.sa2.n_fps, config.sa3.n_fps
    return np.dtype([
        ("xyz", "f4", (n1, 3)),  # centroids of SA1; the first n2 are SA2's, the first n3 SA3's
        ("group_sa1", "f4", (n1, config.sa1.n_n, 4)),  # SA1's neighbours: f_i, x_i - x'_j [m]
        ("idx_sa2", "u2", (n2, config.sa2.n_n)),  # SA2's neighbours, indices into SA1's centroids
        ("idx_sa3", "u2", (n3, config.sa3.n_n)),  # SA3's neighbours, indices into SA2's centroids
        ("broken", "i4"),  # number of invalid points that were dropped
        ("stats", "f4", len(kitti.STATS)),  # scan statistics, to warn about domain shift
    ])


def scan_geometry(scan: np.ndarray, config: Config = Config()) -> np.ndarray:
    """Sample and group a scan for all three set abstractions: (N,4) -> `geometry_dtype` record.

    scan: x, y, z [m] in the Velodyne frame, and intensity 0 to 1. Nothing is learned here, so the
    record is computed once for every scan and kept. Raises ValueError if too few points are usable.
    """
    scan, broken = usable_scan(scan, config)
    cloud = np.ascontiguousarray(scan[:, :3])
    centroids = farthest_point_sampling(cloud, config.sa1.n_fps)  # as fps_textbook, faster
    return group_scan(scan, broken, centroids, build_tree(cloud), config)


def usable_scan(scan, config):
    """Scan (N,4) -> the points that the network uses (n,4), and the number of invalid points.

    Raises ValueError if too few points are usable.
    """
    scan, broken = kitti.usable_points(scan, config.max_range, config.plane)
    if len(scan) < config.sa1.n_fps:
        reach = config.max_range or kitti.MAX_VALID_RANGE
        raise ValueError(f"{len(scan)} usable points (finite, within {reach:.0f} m"
                         f"{'' if config.plane else ', off the ground'}), but the network needs "
                         f"{config.sa1.n_fps}; are the coordinates in metres?")
    return scan, broken


def group_scan(scan, broken, centroids, tree, config):
    """Usable points (N,4), indices of SA1's centroids (n1,), cKDTree of the points -> record.

    One sampling serves all layers. Farthest point sampling of SA1's centroids, from the first one,
    would choose them in the same order again. So SA2's centroids are the first n2 of them, and
    SA3's the first n3.
    """
    sa1, sa2, sa3 = config.sa1, config.sa2, config.sa3
    cloud = np.ascontiguousarray(scan[:, :3])
    neighbours = group_ball(cloud, centroids, sa1.r, sa1.n_n, tree)  # (n1,k1)

    out = np.zeros((), geometry_dtype(config))
    out["xyz"] = xyz = cloud[centroids]  # (n1,3)
    out["group_sa1"][..., 0] = scan[neighbours, 3]  # (n1,k1)
    out["group_sa1"][..., 1:] = cloud[neighbours] - xyz[:, None]  # (n1,k1,3)
    first_n2, first_n3 = np.arange(sa2.n_fps), np.arange(sa3.n_fps)
    out["idx_sa2"] = group_ball(xyz, first_n2, sa2.r, sa2.n_n)
    out["idx_sa3"] = group_ball(xyz[first_n2], first_n3, sa3.r, sa3.n_n)
    out["broken"], out["stats"] = broken, kitti.scan_stats(scan, xyz)
    return out


class Batch(NamedTuple):
    """The network's input as tensors: C scans and B pairs (P, Q) of them.

    A scan may serve as P in one pair and as Q in another.
    """

    xyz: torch.Tensor  # (C,n1,3) centroids
    group_sa1: torch.Tensor  # (C,n1,k1,4)
    idx_sa2: torch.Tensor  # (C,n2,k2)
    idx_sa3: torch.Tensor  # (C,n3,k3)
    p: torch.Tensor  # (B,) index of P among the scans
    q: torch.Tensor  # (B,) index of Q among the scans
    idx_fe: torch.Tensor  # (B,n1,k) neighbours in Q of each centroid of P


def make_batch(scans, p, q, config, device="cpu"):
    """Records of scans (C,) and index arrays p, q (B,) -> Batch. Torch needs int64 indices."""
    idx_sa2, idx_sa3 = scans["idx_sa2"].astype(np.int64), scans["idx_sa3"].astype(np.int64)
    arrays = scans["xyz"], scans["group_sa1"], idx_sa2, idx_sa3, p, q
    tensors = [to_device(array, device) for array in arrays]
    idx_fe = neighbours_in_q(tensors[0], p, q, config.fe.n_n)  # `group_knn` for every pair
    return Batch(*tensors, idx_fe)


def neighbours_in_q(xyz, p, q, k):
    """For every pair (P, Q) the k nearest centroids of Q for each centroid of P.

    Centroids xyz (C,n,3) and index arrays p, q (B,) -> (B,n,k). Uses `group_knn` on a CPU. On other
    devices the search runs there, to avoid waiting for the CPU.
    """
    if xyz.device.type == "cpu":
        xyz = xyz.numpy()
        return torch.from_numpy(np.stack([group_knn(xyz[j], xyz[i], k) for i, j in zip(p, q)]))
    return knn_by_matrix(xyz[p], xyz[q], k)


# ------------------------------------------------------------------------------------------------
# 3  The network: section 3.3


def mlp_layers(c, widths):
    """An MLP such as h in eqs. 3 and 4. For each width: linear, batch normalisation, ReLU."""
    layers = []
    for c_in, c_out in itertools.pairwise((c, *widths)):
        layers += [nn.Linear(c_in, c_out), nn.BatchNorm1d(c_out), nn.ReLU()]
    return nn.Sequential(*layers)


def gather(x, idx):
    """x (B,n,D), idx (B,S,k) -> (B,S,k,D): for every b the rows idx[b] of x[b]."""
    b = torch.arange(len(x), device=x.device)[:, None, None]
    return x[b, idx]


class MiniPointNet(nn.Module):
    """Section 3.3.1: the same MLP h for every point, then the maximum over the points."""

    def __init__(self, c, widths):
        super().__init__()
        self.h = mlp_layers(c, widths)

    def forward(self, f):
        """Features f (...,k,c) of k points -> (...,c')."""
        points = f.flatten(0, -2)  # (points,c): the MLP is shared by all of them
        return self.h(points).unflatten(0, f.shape[:-1]).amax(-2)


class SetAbstraction(nn.Module):
    """Section 3.3.2, eq. 3: f'_j = max_i h_sa(f_i, x_i - x'_j) over the neighbours i of j."""

    def __init__(self, c, layer):
        super().__init__()
        self.mpn = MiniPointNet(c + 3, layer.widths)

    def forward(self, x, f, idx):
        """x (B,n,3), f (B,n,c), idx (B,S,k) -> f' (B,S,c'); centroids are the first S points."""
        x_i, f_i = gather(x, idx), gather(f, idx)  # (B,S,k,3), (B,S,k,c)
        x_j = x[:, :idx.shape[1], None]  # (B,S,1,3)
        return self.mpn(torch.cat([f_i, x_i - x_j], -1))  # (B,S,c')


class FlowEmbedding(nn.Module):
    """Section 3.3.3, eq. 4: e_i = max_j h_fe(f_i, g_j, y_j - x_i) over i's neighbours j in Q."""

    def __init__(self, c, layer):
        super().__init__()
        self.mpn = MiniPointNet(2 * c + 3, layer.widths)

    def forward(self, x, f, y, g, idx):
        """P: x (B,S,3), f (B,S,c); Q: y (B,n,3), g (B,n,c); idx (B,S,k) -> e (B,S,c')."""
        y_j, g_j = gather(y, idx), gather(g, idx)  # (B,S,k,3), (B,S,k,c)
        f_i = f[:, :, None].expand_as(g_j)  # (B,S,k,c)
        x_i = x[:, :, None]  # (B,S,1,3)
        return self.mpn(torch.cat([f_i, g_j, y_j - x_i], -1))  # (B,S,c')


class D3DLO(nn.Module):
    """The network of Fig. 1 and Table 1; 61,290 parameters with the default Config."""

    # Section 3.2: the output is a translation in metres and Euler angles in degrees. `encode` turns
    # motions (...,4,4) into such vectors (...,6). `decode` is its inverse.
    encode, decode = staticmethod(to_vector), staticmethod(from_vector)

    def __init__(self, config: Config = Config()):
        super().__init__()
        self.config = config
        self.sa1 = SetAbstraction(1, config.sa1)  # c = 1, the intensity
        self.fe = FlowEmbedding(config.sa1.widths[-1], config.fe)
        self.sa2 = SetAbstraction(config.fe.widths[-1], config.sa2)
        self.sa3 = SetAbstraction(config.sa2.widths[-1], config.sa3)
        self.mpn = MiniPointNet(config.sa3.widths[-1], config.mpn.widths)
        *hidden, out = config.mlp.widths  # 64, 6
        self.mlp = mlp_layers(config.mpn.widths[-1], hidden)
        self.mlp.append(nn.Linear(hidden[-1], out))

    def forward(self, batch: Batch) -> torch.Tensor:
        """Batch -> y_hat (B,6): [tx, ty, tz] in metres, [roll, pitch, yaw] in degrees, of T_pq."""
        p, q = batch.p, batch.q
        # SA1 for every scan, eq. 3. Its inputs [f_i, x_i - x'_j] were gathered in `group_scan`,
        # since a record holds only the neighbours and not the whole scan.
        features = self.sa1.mpn(batch.group_sa1)  # (C,1024,32)
        # FE for every pair, eq. 4. (index_select has a faster backward pass than [p].)
        x, f = batch.xyz[p], features.index_select(0, p)  # (B,1024,3), (B,1024,32) of P
        y, g = batch.xyz[q], features.index_select(0, q)  # (B,1024,3), (B,1024,32) of Q
        e = self.fe(x, f, y, g, batch.idx_fe)  # (B,1024,64)
        # SA2 and SA3 on P, eq. 3
        f2 = self.sa2(x, e, batch.idx_sa2[p])  # (B,256,64)
        x2 = x[:, :self.config.sa2.n_fps]  # (B,256,3)
        f3 = self.sa3(x2, f2, batch.idx_sa3[p])  # (B,64,64)
        # Mini-PointNet and MLP
        global_feature = self.mpn(f3)  # (B,256)
        return self.mlp(global_feature)  # (B,6)


# ------------------------------------------------------------------------------------------------
# 4  Training: eq. 2 and section 4

STORE_EVERY = 300.0  # seconds between two checkpoints


class UnweightedLoss(nn.Module):
    """Eq. 2: the mean absolute error of all six outputs, metres and degrees alike."""

    def forward(self, y_hat, y):
        """Predictions and targets (B,6), (B,6) -> the loss ()."""
        return (y - y_hat).abs().mean()


def training_batch(geometry, motions, pairs, config, rng, device="cpu"):
    """Load n pairs of scans for training -> Batch, and the motions T_pq (B,4,4) to predict.

    pairs: (n,2), the index s of the sequence and i of the scan P; Q is scan i + 1. With
    augmentation, some pairs imitate refinement: Q may be several scans later, and is aligned with P
    up to a small motion. Each pair is used in one random direction (B = n) or in both (B = 2n).
    """
    n = len(pairs)
    aligned = np.zeros(n, bool)
    if config.augment:
        aligned = rng.random(n) < ALIGNED
    scans_p, scans_q, T_pq = [], [], []
    for (s, i), is_aligned in zip(pairs, aligned):
        j = later_scan(motions[s], i, rng) if is_aligned else i + 1
        scans_p.append(geometry[s][i])
        scans_q.append(geometry[s][j])
        T_pq.append(functools.reduce(np.matmul, motions[s][i:j]))  # T_{i,i+1} ... T_{j-1,j}
    scans, T_pq = np.stack(scans_p + scans_q), np.stack(T_pq)  # all P, then all Q
    if config.augment:
        scans, T_pq = augment(scans, T_pq, aligned, rng)
    p, q, T_qp = np.arange(n), np.arange(n, 2 * n), invert(T_pq)
    if config.swap == "both":
        p, q, T = np.r_[p, q], np.r_[q, p], np.concatenate([T_pq, T_qp])
    else:  # section 4: swap P and Q at random, and invert the motion
        swapped = rng.random(n) >= 0.5
        p, q = np.where(swapped, q, p), np.where(swapped, p, q)
        T = np.where(swapped[:, None, None], T_qp, T_pq)
    return make_batch(scans, p, q, config, device), T


def all_pairs(motions):
    """All pairs of consecutive scans (pairs,2): the index of the sequence and of the first scan."""
    return np.array([(s, i) for s, T in enumerate(motions) for i in range(len(T))])


def steps_per_epoch(motions, config):
    """Number of batches in an epoch, in which every pair occurs once.

    A batch has `config.batch` pairs or more, but fewer than twice as many. If there are fewer pairs
    in all, they form one batch. Raises ValueError if a batch would hold one pair in one direction:
    the final MLP sees one row per pair, so batch normalisation would have no statistics.
    """
    pairs = sum(map(len, motions))
    if config.swap == "random" and min(pairs, config.batch) < 2:
        raise ValueError(f"batch size {config.batch} with {pairs} training pairs: batch "
                         "normalisation needs at least 2 pairs per batch")
    return max(1, pairs // config.batch)


def batches(geometry, motions, config, seed, start, stop, device="cpu"):
    """Yield training batches `start` to `stop` - 1. A thread prepares the next one meanwhile.

    A batch depends only on `seed` (a tuple) and its number, so an interrupted training run
    continues with the batches it would have seen.
    """
    pairs, per_epoch = all_pairs(motions), steps_per_epoch(motions, config)

    def prepare(step):
        epoch, part = divmod(step, per_epoch)
        order = np.random.default_rng([*seed, epoch]).permutation(len(pairs))
        chosen = np.array_split(order, per_epoch)[part]  # parts of nearly equal size
        # part + 1, since NumPy treats the seeds [*seed, epoch] and [*seed, epoch, 0] alike
        rng = np.random.default_rng([*seed, epoch, part + 1])
        return training_batch(geometry, motions, pairs[chosen], config, rng, device)

    with ThreadPoolExecutor(1) as thread:
        following = thread.submit(prepare, start)
        for step in range(start, stop):
            batch = following.result()
            if step + 1 < stop:
                following = thread.submit(prepare, step + 1)
            yield batch


def make_optimizers(net, objective):
    """Adam, as in section 4. With "muon": Muon for the weight matrices of hidden layers, Adam for
    all other parameters.

    Muon's steps are scaled to the size of Adam's, so both use the same learning rate.
    """
    config, parameters = net.config, [*net.parameters(), *objective.parameters()]
    if config.optimizer == "adam":
        return [torch.optim.Adam(parameters, config.lr)]
    hidden = {p for p in net.parameters() if p.ndim == 2} - {net.mlp[-1].weight}
    return [torch.optim.Adam([p for p in parameters if p not in hidden], config.lr),
            torch.optim.Muon([p for p in parameters if p in hidden], config.lr, weight_decay=0,
                             adjust_lr_fn="match_rms_adamw")]


def make_scheduler(optimizer, config, steps):
    """Learning rate decays at epochs 300 and 400 of 500 (section 4), or PyTorch's one-cycle."""
    if config.schedule == "one-cycle":
        return torch.optim.lr_scheduler.OneCycleLR(optimizer, config.lr, total_steps=steps)
    decays = [max(1, steps * 3 // 5), max(1, steps * 4 // 5)]  # 300/500 and 400/500
    return torch.optim.lr_scheduler.MultiStepLR(optimizer, decays, gamma=0.1)


class Training:
    """A training run (section 4): a network, its optimisers, and the files in RUN.

    geometry, motions: two lists, with records (n,) and T_{t,t+1} (n-1,4,4) of each sequence.
    objective: a module (y_hat, y) -> loss. None: eq. 2.
    facts: values to store with the weights, see `training_facts`.

    Batch normalisation uses the statistics of each batch. With `config.frozen`, they are computed
    once from many batches at step `frozen_from`, and stay fixed from then on.
    """

    def __init__(self, net, geometry, motions, run, seed=0, device="cpu", objective=None, **facts):
        self.net, self.config, self.device = net, net.config, device
        self.model = for_device(net, device)  # shares the parameters of net
        self.objective = (objective or UnweightedLoss()).to(device)
        self.geometry, self.motions, self.seed = geometry, motions, seed
        self.run, self.facts = Path(run), facts
        self.per_epoch = steps_per_epoch(motions, self.config)
        self.total_steps = self.config.epochs * self.per_epoch
        self.frozen_from = round(self.total_steps * (1 - self.config.frozen))
        self.step, self.losses = 0, []  # the losses of this epoch
        self.between_steps = True  # False while the weights change
        self.optimizers = make_optimizers(net, self.objective)
        self.schedulers = [make_scheduler(optimizer, self.config, self.total_steps)
                           for optimizer in self.optimizers]

    def remaining_batches(self):
        """Yield the batches of the remaining steps."""
        return batches(self.geometry, self.motions, self.config, (self.seed,), self.step,
                       self.total_steps, self.device)

    def bn_batches(self):
        """Yield batches for recomputing BatchNorm's statistics, with a random seed of their own."""
        return batches(self.geometry, self.motions, self.config, (self.seed, 2**31), 0,
                       min(25, self.total_steps), self.device)

    def train_step(self, batch, T):
        """Predict, compare, and update the weights.

        Raises FloatingPointError if the loss is not finite.
        """
        self.between_steps = False
        if self.step == self.frozen_from:
            update_bn(self.bn_batches(), self.model)  # takes the first element of each (Batch, T)
        self.model.train(self.step < self.frozen_from)
        loss = self.objective(self.model(batch), targets(self.model, batch, T))
        require_finite(loss.item(), "the loss")
        self.model.zero_grad()
        self.objective.zero_grad()
        loss.backward()
        for optimizer, scheduler in zip(self.optimizers, self.schedulers):
            optimizer.step()
            scheduler.step()
        self.losses.append(loss.item())
        self.step += 1
        self.between_steps = True

    def eval_copies(self):
        """Copy the network for inference, in eval mode. Returns the copy and its `for_device` form.

        BatchNorm's running statistics lag behind the weights, so they are recomputed. If they were
        fixed, they are kept, since the weights were trained with them. Raises FloatingPointError if
        a weight or a statistic is not finite.
        """
        net = copy.deepcopy(self.net)
        model = for_device(net, self.device)
        if self.step <= self.frozen_from:
            update_bn(self.bn_batches(), model)
        total = sum(tensor.double().sum().item() for tensor in net.state_dict().values())
        require_finite(total, "a weight or BatchNorm statistic")
        return net.eval(), model.eval()

    def learning_rate(self):
        """The learning rate of the next step."""
        return self.optimizers[0].param_groups[0]["lr"]

    def stateful(self):
        """All objects with a state_dict that training changes, by their names in a checkpoint."""
        stateful = {"model": self.net, "objective": self.objective}
        for i, (optimizer, scheduler) in enumerate(zip(self.optimizers, self.schedulers)):
            stateful |= {f"optimizer{i}": optimizer, f"scheduler{i}": scheduler}
        return stateful

    def load(self, checkpoint):
        """Continue from the content of a checkpoint."""
        self.step, self.losses = checkpoint["step"], checkpoint["losses"]
        for name, part in self.stateful().items():
            part.load_state_dict(checkpoint[name])

    def store_checkpoint(self):
        """Write RUN/checkpoint.pt, from which training can continue."""
        states = {name: part.state_dict() for name, part in self.stateful().items()}
        save(self.run / "checkpoint.pt", config=self.config.as_dict(), step=self.step,
             losses=self.losses, **self.facts, **states)

    def store_weights(self, net):
        """Write RUN/weights.pt from a network that `eval_copies` returned."""
        save(self.run / "weights.pt", model=net.state_dict(), config=self.config.as_dict(),
             step=self.step, **self.facts)

    @contextmanager
    def checkpoint_on_error(self):
        """Store a checkpoint if an exception is raised while no step is in progress.

        A FloatingPointError stores nothing and becomes a ValueError.
        """
        try:
            yield
        except FloatingPointError as error:
            stored = (self.run / "checkpoint.pt").exists()
            raise ValueError(f"{self.run}: {error} at step {self.step} (learning rate "
                             f"{self.learning_rate():.1e})"
                             f"{'; the last checkpoint was kept' if stored else ''}. "
                             "Try a lower learning rate") from None
        except BaseException:
            if self.between_steps:
                self.store_checkpoint()
            raise


def targets(net, batch, T):
    """Motions T (B,4,4) as regression targets y (B,6), on the device of the batch."""
    return to_device(net.encode(T).astype(np.float32), batch.xyz.device)


def require_finite(number, name):
    """Raise FloatingPointError unless `number` is finite."""
    if not math.isfinite(number):
        raise FloatingPointError(f"{name} became non-finite")


@torch.inference_mode()
def mean_loss(net, objective, examples):
    """The mean loss over `examples`, an iterable of (Batch, T).

    Raises FloatingPointError if it is not finite.
    """
    losses = [objective(net(batch), targets(net, batch, T)).item() for batch, T in examples]
    require_finite(sum(losses), "the loss")
    return np.mean(losses)


def test_examples(geometry, motions, config, device):
    """Yield (Batch, T) of 500 evenly spaced pairs, or of all if fewer, in both directions."""
    pairs = all_pairs(motions)
    chosen = np.unique(np.linspace(0, len(pairs) - 1, 500).astype(int))
    as_they_are = replace(config, swap="both", augment=False)
    for part in np.array_split(chosen, math.ceil(len(chosen) / 16)):
        yield training_batch(geometry, motions, pairs[part], as_they_are, None, device)


def fit(net, geometry, motions, run, seed=0, device="cpu", checkpoint=None, say=print,
        objective=None, test=None, **facts):
    """Train `net` in place as `net.config` says (section 4). Returns a copy for inference.

    geometry, motions, run, objective, facts: see `Training`.
    seed: random seed for pair order and augmentation.
    checkpoint: the content of a checkpoint to continue from.
    say: called with each line to report.
    test: geometry and motions of the test sequences. Their loss is reported after every epoch. The
        weights do not depend on it.

    Every STORE_EVERY seconds and at the end, RUN/checkpoint.pt and RUN/weights.pt are written.
    Ctrl-C lets the current step finish. Raises ValueError if the loss, a weight or a statistic is
    not finite; nothing further is stored then.
    """
    facts = facts or training_facts({}, motions, geometry)
    training = Training(net, geometry, motions, run, seed, device, objective, **facts)
    if checkpoint:
        training.load(checkpoint)
    remaining, last_stored = training.total_steps - training.step, time.monotonic()
    with kitti.delayed_interrupt() as interrupted, training.checkpoint_on_error():
        for batch, T in progress(training.remaining_batches(), remaining, "training, batches"):
            rate = training.learning_rate()
            training.train_step(batch, T)
            if training.step % training.per_epoch == 0:
                loss, training.losses = np.mean(training.losses), []
                epoch = training.step // training.per_epoch
                line = f"epoch {epoch}/{net.config.epochs}: loss {loss:.4f}"
                if test:
                    _, model = training.eval_copies()
                    examples = test_examples(*test, net.config, device)
                    line += f", test loss {mean_loss(model, training.objective, examples):.4f}"
                say(f"{line}, learning rate {rate:.1e}")
            if interrupted:
                raise KeyboardInterrupt(f"step {training.step} is stored; to continue: "
                                        f"python d3dlo.py train --out {run} --resume")
            if time.monotonic() - last_stored > STORE_EVERY:
                trained, _ = training.eval_copies()
                training.store_checkpoint()
                training.store_weights(trained)
                last_stored = time.monotonic()
        trained, model = training.eval_copies()
        loss = mean_loss(model, training.objective, training.bn_batches())
        training.store_checkpoint()
        training.store_weights(trained)
    if interrupted:  # after the last step
        raise KeyboardInterrupt(f"the weights are complete: {run}/weights.pt")
    say(f"training loss in eval mode: {loss:.4f}")
    return trained


# ------------------------------------------------------------------------------------------------
# 5  Weights files and devices

FORMAT_VERSION = 2  # of weights files and checkpoints; increase it when the format changes
PRETRAINED = Path(__file__).with_name("d3dlo.pt")


def checksum(state):
    """CRC-32 of the network's tensors and of the facts stored with them."""
    facts = ("config", "step", "train", "before", "mean_motion", "seen")
    text = json.dumps([state[name] for name in facts], sort_keys=True)
    tensors = [tensor.cpu().numpy().tobytes() for tensor in state["model"].values()]
    return zlib.crc32(b"".join([text.encode(), *tensors]))


def save(path, **state):
    """Write weights or a checkpoint: state_dicts and plain values. Raises OSError on failure."""
    with metrics.replacing(path) as temporary, open(temporary, "wb") as file:
        try:
            torch.save({**state, "crc": checksum(state), "format": FORMAT_VERSION}, file)
        except RuntimeError as error:  # torch raises this when the disk is full
            reason = str(error).splitlines()[0]
            raise OSError(f"{path}: could not be written ({reason:.80})") from None


def load_weights(path: str | Path | None = None, network=D3DLO, checkpoint: bool = False):
    """Read a weights file. Returns the network, in eval mode, and the content of the file, a dict.

    path: the file, or the folder of a training run. None: the pretrained weights.
    network: the class of the network, which is built from the settings in the file.
    checkpoint: read a checkpoint to continue from, not weights.

    Raises FileNotFoundError if there is no such file, and ValueError if it is damaged or of another
    kind.
    """
    path = Path(path or PRETRAINED)
    path = path / "weights.pt" if path.is_dir() else path
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; give a weights.pt or the folder of a "
                                "training run, as `python d3dlo.py train` writes them")
    try:
        if zipfile.ZipFile(path).testzip():  # torch does not verify the archive's checksums
            raise ValueError("damaged")
        state = torch.load(path, map_location="cpu", weights_only=True)
        if state.get("format") != FORMAT_VERSION:
            raise ValueError(f"file format {state.get('format')}, but this version reads format "
                             f"{FORMAT_VERSION}")
        net = network(Config(**state["config"]))
        net.load_state_dict(state["model"])
        if checksum(state) != state["crc"]:
            raise ValueError("damaged")
    except Exception as error:  # torch and pickle raise many exception types for a bad file
        reason = f"{type(error).__name__}: {error}".splitlines()[-1].strip()
        if isinstance(error, pickle.UnpicklingError):  # torch's own text is long
            reason = "it is damaged, or holds Python objects, which are not loaded for safety"
        raise ValueError(f"{path}: cannot be read as D3DLO weights ({reason:.120}); give a "
                         "weights.pt or the folder of a training run") from None
    if checkpoint and "losses" not in state:
        raise ValueError(f"{path}: holds weights, but no training run to continue")
    if not checkpoint and "losses" in state:
        raise ValueError(f"{path}: is a checkpoint, which only training can use; give the "
                         "weights.pt beside it")
    return net.eval(), state


# Arguments and devices


def check_number(name, value):
    """Raise ValueError unless a value is a non-negative integer of at most 63 bits."""
    whole = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    if not (whole and 0 <= value < 2**63):
        raise ValueError(f"{name} must be a non-negative integer, not {value!r}")


def check_device(device):
    """Raise ValueError if this PyTorch cannot use the device."""
    try:
        torch.empty(1, device=device).cpu()
    except (RuntimeError, AssertionError, NotImplementedError):
        raise ValueError(f"device {device}: this PyTorch cannot use it; use cpu, or install a "
                         "PyTorch for it") from None


def for_device(net, device):
    """The version of a network to run on a device: `fast` on a CPU, the plain one elsewhere."""
    return fast(net) if torch.device(device).type == "cpu" else net.to(device)


def to_device(array, device):
    """NumPy array -> tensor on a device. Copies to a GPU do not block."""
    tensor = torch.from_numpy(np.ascontiguousarray(array))
    if torch.device(device).type == "cuda":
        tensor = tensor.pin_memory()
    return tensor.to(device, non_blocking=True)


# ------------------------------------------------------------------------------------------------
# 6  Odometry: eq. 1


def accumulate(motions):
    """Motions (n-1,4,4) -> poses (n,4,4) by eq. 1, T_{0,t+1} = T_{0,t} T_{t,t+1}.

    The first pose is the identity.
    """
    return np.stack([*itertools.accumulate(motions, np.matmul, initial=np.eye(4))])


@torch.inference_mode()
def predict(net, scans, p, q, device):
    """Records of scans (C,) and index arrays p, q (B,) -> T_pq (B,4,4), in one forward pass."""
    y_hat = net(make_batch(scans, p, q, net.config, device)).cpu().numpy()
    if not np.isfinite(y_hat).all():
        raise ValueError("the prediction is not finite; are the intensities between 0 and 1?")
    return net.decode(y_hat)


def predict_motions(net, records, device="cpu", batch=16):
    """Records of consecutive scans (n,) -> T_{t,t+1} (n-1,4,4), Velodyne frame."""
    motions = [np.empty((0, 4, 4))]
    for i in range(0, len(records) - 1, batch):
        scans = records[i:i + batch + 1]
        p = np.arange(len(scans) - 1)
        motions.append(predict(net, scans, p, p + 1, device))
    return np.concatenate(motions)


MAX_REFINE = 100  # passes; the time and memory of a scan grow with them
INVALID_POINTS = "invalid points (not finite, or range or intensity out of bounds)"
SHIFT_WARNING = "scans look unlike the training data; the poses may be wrong"


class Odometry:
    """Poses from a stream of scans: `Odometry().register(scan)`.

    weights: a weights file or the folder of a training run. None: the pretrained weights.
    device: cpu, cuda or mps.
    refine: number of refinement passes, see `refine_pose`. 0: the paper's plain prediction.
    network: the class of the network.

    Raises ValueError if an argument or the weights are invalid, and FileNotFoundError if there is
    no such weights file.
    """

    def __init__(self, weights: str | Path | None = None, device: str = "cpu", refine: int = 0,
                 network=D3DLO):
        check_device(device)
        check_number("refine", refine)
        if refine > MAX_REFINE:
            raise ValueError(f"refine must be at most {MAX_REFINE} passes, not {refine}")
        net, self.facts = load_weights(weights, network)
        self.net, self.device, self.refine = for_device(net, device), device, refine
        self.warned = False  # about scans unlike those in training
        self.restart()

    def restart(self):
        """Forget all scans. The next one defines the frame of the poses."""
        self.last = self.keyframe = None  # records and pose of the last scan and of a keyframe

    def register(self, scan: np.ndarray) -> np.ndarray:
        """Scan (N,4): x, y, z [m], intensity 0 to 1 -> its pose T_0t (4,4), Velodyne frame.

        The first pose is the identity. Warns about invalid points and, once, about scans unlike
        those in training. Raises ValueError if the scan cannot be used; the state is then
        unchanged.
        """
        records = several_samplings(scan, self.net.config, max(self.refine, 1))
        if records[0]["broken"]:
            warnings.warn(f"dropped {records[0]['broken']} {INVALID_POINTS}", stacklevel=2)
        pose = self.register_records(records)
        shift = kitti.domain_shift(records[0]["stats"], self.facts["seen"])
        if shift and not self.warned:
            warnings.warn(f"{SHIFT_WARNING}: {shift}", stacklevel=2)
            self.warned = True
        return pose

    def register_records(self, records):
        """`register` for a scan that is sampled already: records (max(refine, 1),) -> its pose."""
        pose = np.eye(4)
        if self.last:
            last_records, last_pose = self.last
            pair = np.stack([last_records[0], records[0]])
            T_pq, = predict_motions(self.net, pair, self.device)
            pose = last_pose @ T_pq  # eq. 1
        # Refine the pose: once with a keyframe, an earlier scan that is replaced every few metres,
        # then with the last scan. The keyframe limits how fast errors add up from scan to scan.
        if self.refine and self.keyframe:
            references = [self.keyframe] + [self.last] * (self.refine - 1)
            pose = refine_pose(self.net, references, records, pose, self.device)
        if self.refine and (not self.keyframe or is_far(invert(self.keyframe[1]) @ pose)):
            self.keyframe = records, pose
        self.last = records, pose
        return pose.copy()


def relative_pose(scan_p: np.ndarray, scan_q: np.ndarray, weights: str | Path | None = None,
                  refine: int = 0) -> np.ndarray:
    """Scans P and Q, (N,4) each -> T_pq (4,4), which maps points of Q into P's Velodyne frame.

    Translation in metres. Loads the weights at every call, so `Odometry` is faster for many scans.
    Raises the same errors as `Odometry` and `Odometry.register`.
    """
    odometry = Odometry(weights, refine=refine)
    odometry.register(scan_p)
    return odometry.register(scan_q)


# ------------------------------------------------------------------------------------------------
# 7  Evaluation: section 5

BASELINES = "standing still", "mean training motion"
LEGEND = """E_t, E_r: KITTI's segments of 100 to 800 m, rectified left camera frame. t step, r step:
mean translation and rotation of inv(T_est) @ T_true per step, Velodyne frame. -: no such segment,
or no ground truth."""
GEOMETRY_VERSION = 4  # increase it when `scan_geometry` changes, so that old caches are not read


def load_geometry(sequences, config, cache="cache"):
    """Compute `scan_geometry` of all scans of the sequences, or read it from the folder `cache`.

    Returns two lists with an entry for each sequence: records (n,), and a fingerprint of the data.
    Raises ValueError, naming the file, for a scan that `scan_geometry` rejects.
    """
    compute = functools.partial(scan_geometry, config=config)
    dtype = geometry_dtype(config)
    depends = (GEOMETRY_VERSION, config.sa1.r, config.sa2.r, config.sa3.r, config.plane,
               config.max_range)  # and on n_fps and n_n, which determine dtype
    geometry, crcs = kitti.cached_records(sequences, compute, dtype, depends, cache)
    for s, records in zip(sequences, geometry):
        if (broken := records["broken"]).any():
            print(f"sequence {s.name}: dropped {broken.sum()} {INVALID_POINTS} in "
                  f"{np.count_nonzero(broken)} of {len(s)} scans", file=sys.stderr)
    return geometry, [kitti.fingerprint(s, crc) for s, crc in zip(sequences, crcs)]


def warn_about_shift(s, records, seen):
    """Warn on stderr if scans of a sequence are unlike those in training, `seen`."""
    shifts = [kitti.domain_shift(stats, seen) for stats in records["stats"]]
    shifts = [shift for shift in shifts if shift]
    if shifts:
        print(f"sequence {s.name}: {len(shifts)} of {len(s)} {SHIFT_WARNING}: {shifts[0]}",
              file=sys.stderr)


def predict_poses(odometry, s, records):
    """Poses T_0t (n,4,4) of all scans of a sequence, whose records (n,) are known."""
    warn_about_shift(s, records, odometry.facts["seen"])
    if not odometry.refine:  # many pairs at a time are faster than one by one
        return accumulate(predict_motions(odometry.net, records, odometry.device))
    odometry.restart()
    poses = []
    for i in progress(range(len(s)), len(s), f"registering {s.name}, scans"):
        try:
            samplings = several_samplings(s.scan(i), odometry.net.config, odometry.refine)
            poses.append(odometry.register_records(samplings))
        except ValueError as error:
            raise ValueError(f"{s.scan_paths[i]}: {error}") from None
    return np.stack(poses)


def evaluate_sequence(odometry, s, records, out):
    """Predict the trajectory of a sequence and write OUT/NN.txt, a KITTI pose file.

    Returns {predictor: (segment errors, step errors)} for the network and the BASELINES, or {}
    without ground truth.
    """
    poses = predict_poses(odometry, s, records)
    metrics.write_poses(out / f"{s.name}.txt", kitti.velo_to_camera(poses, s.Tr))
    if s.poses is None:
        return {}
    still = np.tile(np.eye(4), (len(s) - 1, 1, 1))
    mean = np.tile(from_vector(odometry.facts["mean_motion"]), (len(s) - 1, 1, 1))
    errors = {}
    for predictor, T in zip(("network", *BASELINES), (poses, accumulate(still), accumulate(mean))):
        segments = metrics.segment_errors(s.poses_cam, kitti.velo_to_camera(T, s.Tr))
        errors[predictor] = segments, metrics.step_errors(s.poses, T)
    return errors


def evaluate_sequences(odometry, sequences, out, source):
    """Predict the trajectories of sequences and write OUT/NN.txt. Returns what `summarize` does.

    source: see `claim_results`.
    """
    geometry, fingerprints = load_geometry(sequences, odometry.net.config)
    claim_results(out, source)
    work = progress(zip(sequences, geometry), len(sequences), "registering, sequences")
    errors = {s.name: evaluate_sequence(odometry, s, records, out) for s, records in work}
    # Sequences are compared by content, since different data may have the same name
    known = {*odometry.facts["train"].values(), *odometry.facts["before"]}
    return summarize(errors, {s.name: f in known for s, f in zip(sequences, fingerprints)})


def summarize(errors, trained_on):
    """Average the errors per sequence, split and segment length, in the layout of results.json.

    errors: {sequence: result of `evaluate_sequence`}; trained_on: {sequence: bool}.
    """
    def mean(names, predictor="network"):
        pairs = [errors[name][predictor] for name in names if errors[name]]
        segments, steps = [e for e, _ in pairs], [e for _, e in pairs]
        return metrics.summary(segments, steps) | {"trained_on": any(trained_on[n] for n in names)}

    def pooled(names):
        return mean(names) | {predictor: mean(names, predictor) for predictor in BASELINES}
    splits = {split: [n for n in names if n in errors] for split, names in SPLITS.items()}
    return {"sequences": {name: mean([name]) for name in errors},
            "splits": {split: pooled(names) for split, names in splits.items() if names},
            "pooled": pooled(list(errors)),
            "lengths": metrics.by_length([e["network"][0] for e in errors.values() if e])}


def results_table(results):
    """Format the content of results.json as a table, followed by a line on units and frames."""
    def row(name, s):
        return metrics.row(name + " *" * s["trained_on"], s)

    rows = [row(name, s) for name, s in results["sequences"].items()]
    for name, s in [*results["splits"].items(), ("all", results["pooled"])]:
        rows.append(row(name, s))
        rows += [metrics.row(f"  {predictor}", s[predictor]) for predictor in BASELINES]
    rows += [metrics.row(length, s) for length, s in results["lengths"].items()]
    return f"{metrics.table(metrics.HEADER, rows)}\n*: trained on. {LEGEND}"


# ------------------------------------------------------------------------------------------------
# 8  Our additions, not in the paper: augmentation and refinement


def move_scans(scans, T):
    """Apply rigid motions or mirrors T (C,4,4) to the points in the records of C scans.

    Distances do not change, so sampling and grouping stay valid.
    """
    moved, T = scans.copy(), T.astype(np.float32)
    R_T, t = T[:, :3, :3].transpose(0, 2, 1), T[:, None, :3, 3]
    moved["xyz"] = scans["xyz"] @ R_T + t  # R x + t, with points as rows
    offsets = scans["group_sa1"][..., 1:]  # (C,n1,k1,3)
    moved["group_sa1"][..., 1:] = (offsets.reshape(len(T), -1, 3) @ R_T).reshape(offsets.shape)
    return moved


ALIGNED = 1 / 3  # with augmentation, the share of pairs in which Q is first aligned with P
KEYFRAME_DISTANCE, KEYFRAME_ANGLE = 5.0, 20.0  # [m], [deg] at which refinement takes a new keyframe


def augment(scans, T_pq, aligned, rng):
    """Mirror pairs left to right with probability 1/2, then move every Q by a small random motion.

    scans: records (2n,), first of n scans P and then of their n scans Q. T_pq: (n,4,4). Returns
    both after augmentation. Where `aligned` (n,) is true, Q is first aligned with P by T_pq. A
    motion A that takes each point q of Q to A q turns T_pq into T_pq A^-1. Not in the paper.
    """
    n = len(T_pq)
    mirror = np.where(rng.random((n, 1, 1)) < 0.5, np.diag([1.0, -1, 1, 1]), np.eye(4))
    T_pq = mirror @ T_pq @ mirror
    scale = [0.25, 0.1, 0.03, 0.1, 0.1, 1.0]  # m, degrees; largest in yaw, since turns are rare
    small = from_vector(rng.normal(size=(n, 6)) * scale)
    A = small @ np.where(aligned[:, None, None], T_pq, np.eye(4))
    return move_scans(scans, np.concatenate([mirror, A @ mirror])), T_pq @ invert(A)


def later_scan(motions, i, rng):
    """Draw the index of a scan up to KEYFRAME_DISTANCE metres farther along the path than scan i.

    motions: T_{t,t+1} (n-1,4,4) of the sequence. The result is at least i + 1, even if that scan is
    farther.
    """
    ahead = np.cumsum(np.linalg.norm(motions[i:, :3, 3], axis=1))  # distance to i+1, i+2, ... [m]
    return i + max(1, np.searchsorted(ahead, rng.uniform(0, KEYFRAME_DISTANCE), "right"))


def mean_transform(transforms):
    """Rigid transforms (n,4,4) that are close to each other -> their mean (4,4), also rigid."""
    transforms = np.stack(transforms)
    T = np.eye(4)
    T[:3, :3] = Rotation.from_matrix(transforms[:, :3, :3]).mean().as_matrix()
    T[:3, 3] = transforms[:, :3, 3].mean(0)
    return T


def refine_pose(net, references, samplings, pose, device):
    """Refine the pose T_0q (4,4) of a scan Q with n samplings, records (n,). Returns T_0q.

    references: a list of n pairs (records (n,), pose T_0p), an earlier scan P for each pass.
    Pass k uses sampling k of both scans. It aligns Q with P using the current estimate, predicts
    the residual motion in both directions, and updates the estimate. The result is the mean of all
    n estimates, because most of their error depends on which points were sampled. Not in the paper.
    """
    estimates = []
    for k, (samplings_p, T_0p) in enumerate(references):
        T = invert(T_0p) @ pose  # the current estimate of T_pq
        aligned, = move_scans(samplings[k][None], T[None])
        pair = np.stack([samplings_p[k], aligned])
        T_pq, T_qp = predict(net, pair, np.array([0, 1]), np.array([1, 0]), device)
        pose = T_0p @ mean_transform([T_pq, invert(T_qp)]) @ T
        estimates.append(pose)
    return mean_transform(estimates)


def several_samplings(scan, config, n):
    """Sample a scan n times: (N,4) -> records (n,), see `scan_geometry`. Not in the paper.

    Sampling k takes its centroids from points k, k + n, k + 2n, ..., so no two samplings share a
    centroid. A scan with fewer than n * n1 usable points is split into fewer parts, so some
    samplings are then identical. Neighbours are searched in the whole scan.
    """
    scan, broken = usable_scan(scan, config)
    cloud = np.ascontiguousarray(scan[:, :3])
    parts = min(n, len(cloud) // config.sa1.n_fps)
    size = len(cloud) // parts
    clouds = cloud[:size * parts].reshape(size, parts, 3).swapaxes(0, 1)  # (parts,size,3)
    centroids = batched_fps(clouds, config.sa1.n_fps) * parts  # (parts,n1)
    centroids += np.arange(parts)[:, None]
    tree = build_tree(cloud)
    return np.stack([group_scan(scan, broken, centroids[k % parts], tree, config)
                     for k in range(n)])


def is_far(T):
    """Whether a scan at the pose T (4,4) relative to the keyframe becomes the next keyframe."""
    angle = np.degrees(Rotation.from_matrix(T[:3, :3]).magnitude())
    return np.linalg.norm(T[:3, 3]) >= KEYFRAME_DISTANCE or angle >= KEYFRAME_ANGLE


# ------------------------------------------------------------------------------------------------
# 9  Faster versions of functions in parts 2 and 3
#
# Tests check that every function equals its plain form, up to rounding. On a CPU most of the time
# goes into memory traffic, so these functions avoid large arrays. `knn_by_matrix` is for GPUs.

CHUNK = 192  # points in a chunk; 128 to 256 are about as fast
# SPREAD_BITS[i]: byte i with its bits at every second position (its binary digits read in base 4)
SPREAD_BITS = np.array([int(f"{i:b}", 4) for i in range(256)], np.uint16)


def morton_order(xyz):
    """Sort points (N,3) so that close points are close in the order. Returns indices (N,).

    The order is a Z-order curve: each point's azimuth and log range are scaled to a byte, and the
    bits of the two bytes are interleaved. In these coordinates the points of a LiDAR have a nearly
    uniform density. Affects speed only, never the result of `farthest_point_sampling`.
    """
    x, y = xyz[:, 0], xyz[:, 1]
    with np.errstate(all="ignore"):
        azimuth, log_range = np.arctan2(y, x), np.log(np.hypot(x, y) + 1)
        a, r = (((c - c.min()) * (255 / max(np.ptp(c), 1e-6))).astype(np.uint8)
                for c in (azimuth, log_range))
    return np.argsort(SPREAD_BITS[a] | SPREAD_BITS[r] << 1, kind="stable")


def cut_into_chunks(xyz):
    """Points (N,3) -> m chunks of neighbouring points, with their bounding boxes.

    Returns the indices of the points (m,CHUNK), the points (m,3,CHUNK), and the lowest and highest
    coordinates of each chunk (3,m).
    """
    order = morton_order(xyz)
    # Repeat the last point to fill the last chunk. This changes no distance and no maximum.
    order = np.pad(order, (0, -len(order) % CHUNK), mode="edge").reshape(-1, CHUNK)
    points = np.ascontiguousarray(xyz[order].transpose(0, 2, 1))
    return order, points, points.min(2).T.copy(), points.max(2).T.copy()


def farthest_point_sampling(xyz: np.ndarray, n: int, start: int = 0) -> np.ndarray:
    """`fps_textbook`, faster: xyz (N,3), finite -> (n,) int64 indices, ties to the lowest index.

    The cloud is cut into chunks of neighbouring points. A new centroid can only shorten distances
    in chunks whose bounding box is nearer to it than their largest `min_dist`; all other chunks
    are skipped. The result is nested: its first m indices are the result for n = m. Raises
    ValueError unless 0 < n <= N and 0 <= start < N.
    """
    xyz = np.asarray(xyz)
    if not (0 < n <= len(xyz) and 0 <= start < len(xyz)):
        raise ValueError(f"farthest point sampling of {n} of {len(xyz)} points from index {start}: "
                         f"needs 1 <= n <= {len(xyz)} and 0 <= start < {len(xyz)}")
    xyz = np.asarray(xyz, np.float32 if xyz.dtype == np.float32 else np.float64)
    order, points, low, high = cut_into_chunks(xyz)
    min_dist = np.full(order.shape, np.inf, xyz.dtype)  # (chunks,CHUNK), squared
    largest = min_dist[:, 0].copy()  # (chunks,) the largest of each chunk
    centroids = np.empty(n, np.int64)
    centroids[0] = start
    for i in range(1, n):  # take and reduce have less overhead than indexing and sum
        # Chunks that the last centroid can affect: their bounding box is near enough
        p = xyz[centroids[i - 1], :, None]  # (3,1)
        gap = np.maximum(np.maximum(low - p, p - high), 0)  # (3,chunks) from p to the boxes
        gap *= gap
        near = (np.add.reduce(gap, 0) < largest).nonzero()[0]
        # Update the squared distances in these chunks
        d = points.take(near, 0)  # (near,3,CHUNK); summed in the same order as gap: same rounding
        d -= p
        d *= d
        d = np.minimum(np.add.reduce(d, 1), min_dist.take(near, 0))
        min_dist[near] = d
        largest[near] = np.maximum.reduce(d, 1)
        # The next centroid: the lowest index among the farthest points of all chunks
        best = (largest == np.maximum.reduce(largest)).nonzero()[0]
        d = min_dist.take(best, 0)
        centroids[i] = order.take(best, 0)[d == np.maximum.reduce(d, None)].min()
    return centroids


def batched_fps(clouds, n):
    """`farthest_point_sampling` of K clouds in one loop: (K,N,3) -> (K,n) indices, from index 0.

    For small clouds NumPy's overhead dominates. One loop for all clouds incurs it only once.
    """
    (K, N), xyz = clouds.shape[:2], np.concatenate(clouds)  # (K*N,3)
    if K == 1:
        return farthest_point_sampling(xyz, n)[None]
    orders, points, low, high = zip(*map(cut_into_chunks, clouds))
    order = np.concatenate([order + k * N for k, order in enumerate(orders)])  # (K*m,CHUNK)
    points = np.concatenate(points)  # (K*m,3,CHUNK)
    low, high = np.stack(low, 1), np.stack(high, 1)  # (3,K,m)
    cloud_of_chunk = np.repeat(np.arange(K), low.shape[2])  # (K*m,)
    min_dist = np.full(order.shape, np.inf, xyz.dtype)  # (K*m,CHUNK), squared
    largest = np.full(low.shape[1:], np.inf, xyz.dtype)  # (K,m) the largest of each chunk
    largest_of_chunk = largest.reshape(-1)  # (K*m,), the same memory
    centroids = np.empty((n, K), np.int64)
    centroids[0] = np.arange(K) * N
    for i in range(1, n):  # the same steps as in `farthest_point_sampling`
        p = xyz.take(centroids[i - 1], 0)  # (K,3)
        p_T = p.T[:, :, None]  # (3,K,1)
        gap = np.maximum(np.maximum(low - p_T, p_T - high), 0)  # (3,K,m)
        gap *= gap
        near = (np.add.reduce(gap, 0) < largest).reshape(-1).nonzero()[0]
        d = points.take(near, 0)  # (near,3,CHUNK)
        d -= p.take(cloud_of_chunk.take(near), 0)[:, :, None]
        d *= d
        d = np.minimum(np.add.reduce(d, 1), min_dist.take(near, 0))
        min_dist[near] = d
        largest_of_chunk[near] = np.maximum.reduce(d, 1)
        best = (largest == np.maximum.reduce(largest, 1, keepdims=True)).reshape(-1).nonzero()[0]
        farthest = min_dist.take(best, 0) == largest_of_chunk.take(best)[:, None]
        lowest = np.where(farthest, order.take(best, 0), K * N).min(1)  # (best,)
        centroids[i] = K * N
        np.minimum.at(centroids[i], cloud_of_chunk.take(best), lowest)
    return centroids.T - np.arange(K)[:, None] * N


def build_tree(xyz):
    """cKDTree(xyz), with options that make it faster to build and its queries no slower."""
    return cKDTree(xyz, leafsize=48, balanced_tree=False, compact_nodes=False)


def knn_by_matrix(x, y, k):
    """`group_knn` by a matrix of distances: x (B,S,3), y (B,n,3) -> (B,S,k) indices into y."""
    distances = torch.cdist(x, y, compute_mode="donot_use_mm_for_euclid_dist")  # accurate
    idx = distances.topk(min(k, y.shape[1]), largest=False).indices  # (B,S,k), nearest first
    missing = k - idx.shape[2]  # repeat the nearest when there are fewer than k points
    return torch.cat([idx, idx[..., :1].expand(-1, -1, missing)], 2) if missing else idx


def fast(net):
    """A version of a D3DLO, or of a subclass, that is faster on a CPU.

    It computes the same function and shares the parameters and buffers of `net`, so training one
    trains the other, and both have the same state_dict.
    """
    # deepcopy does not copy what its memo lists, so both networks share these tensors
    memo = {id(tensor): tensor for tensor in (*net.parameters(), *net.buffers())}
    twin = copy.deepcopy(net, memo)
    # The fast classes differ in their methods only, so a module can change its class
    faster = {MiniPointNet: FastMiniPointNet, SetAbstraction: FastSetAbstraction,
              FlowEmbedding: FastFlowEmbedding}
    for module in twin.modules():
        module.__class__ = faster.get(type(module), type(module))
    return twin


class FastMiniPointNet(MiniPointNet):
    """`MiniPointNet` that takes the maximum before the last batch normalisation and ReLU."""

    def forward(self, f):
        """Features f (B,...,k,c) of k points -> (B,...,c')."""
        return self.after_first_linear(self.h[0](f))

    def after_first_linear(self, z):
        """The output z (B,...,k,c1) of the first linear layer -> (B,...,c')."""
        *hidden, linear, norm, _ = self.h[1:]
        points = z.flatten(0, -2)
        for layer in hidden:
            points = F.relu_(points) if isinstance(layer, nn.ReLU) else layer(points)
        return linear_norm_relu_max(linear, norm, points.unflatten(0, z.shape[:-1]))


class FastSetAbstraction(SetAbstraction):
    """`SetAbstraction` that applies the first linear layer before gathering.

    W [f_i, x_i - x'_j] + b = (W_f f_i + W_x x_i) + (b - W_x x'_j) is a sum of two terms, one for
    the point i and one for the centroid j. So the layer is applied to n points and S centroids
    instead of S k neighbours.
    """

    def forward(self, x, f, idx):
        """x (B,n,3), f (B,n,c), idx (B,S,k) -> f' (B,S,c')."""
        linear = self.mpn.h[0]
        W_f, W_x = linear.weight.split([f.shape[2], 3], 1)
        u = f @ W_f.t() + x @ W_x.t()  # (B,n,c1)
        v = linear.bias - x[:, :idx.shape[1]] @ W_x.t()  # (B,S,c1)
        return self.mpn.after_first_linear(GatherAdd.apply(u, v, idx))


class FastFlowEmbedding(FlowEmbedding):
    """`FlowEmbedding` that applies the first linear layer before gathering, in the same way."""

    def forward(self, x, f, y, g, idx):
        """P: x (B,S,3), f (B,S,c); Q: y (B,n,3), g (B,n,c); idx (B,S,k) -> e (B,S,c')."""
        linear = self.mpn.h[0]
        W_f, W_g, W_x = linear.weight.split([f.shape[2], g.shape[2], 3], 1)
        u = g @ W_g.t() + y @ W_x.t()  # (B,n,c1)
        v = linear.bias + f @ W_f.t() - x @ W_x.t()  # (B,S,c1)
        return self.mpn.after_first_linear(GatherAdd.apply(u, v, idx))


class GatherAdd(torch.autograd.Function):
    """u (B,n,D), v (B,S,D), idx (B,S,k) -> gather(u, idx) + v[:, :, None], (B,S,k,D).

    The backward pass is written out, which takes half as long as autograd's.
    """

    @staticmethod
    def forward(ctx, u, v, idx):
        (B, n, D), k = u.shape, idx.shape[2]
        rows = (idx + n * torch.arange(B, device=idx.device)[:, None, None]).view(-1, 1)
        ctx.save_for_backward(rows)
        ctx.n = n
        gathered = u.reshape(B * n, D).gather(0, rows.expand(-1, D))  # (B*S*k,D)
        return gathered.view(B, -1, k, D).add_(v[:, :, None])

    @staticmethod
    def backward(ctx, grad):
        rows, B, D = ctx.saved_tensors[0], len(grad), grad.shape[-1]
        grad_u = grad.new_zeros(B * ctx.n, D)
        grad_u.scatter_add_(0, rows.expand(-1, D), grad.reshape(-1, D))
        return grad_u.view(B, ctx.n, D), grad.sum(2), None


class LinearMax(torch.autograd.Function):
    """h (B,S,k,D), W (D',D) -> the maximum over k of h W^T, (B,S,D').

    With `moments`, also returns E[h] (D,) and E[h^T h] (D,D) over all B S k rows; without, None.
    The product is computed for one element of the batch at a time, so that (B,S,k,D') never exists
    in full. The backward pass computes it again. Equal maxima share the gradient, as in torch.amax.
    """

    @staticmethod
    def forward(ctx, h, W, moments):
        B, S, k, D = h.shape
        out, z = h.new_empty(B, S, len(W)), h.new_empty(S * k, len(W))
        E_h, E_hh = (h.new_zeros(D), h.new_zeros(D, D)) if moments else (None, None)
        for b, rows in enumerate(h.reshape(B, S * k, D)):
            torch.mm(rows, W.t(), out=z)
            torch.amax(z.view(S, k, -1), 1, out=out[b])
            if moments:
                E_h += rows.sum(0) / (B * S * k)
                E_hh.addmm_(rows.t(), rows, alpha=1 / (B * S * k))
        ctx.save_for_backward(h, W)
        return out, E_h, E_hh

    @staticmethod
    def backward(ctx, grad, grad_E_h, grad_E_hh):
        h, W = ctx.saved_tensors
        B, S, k, D = h.shape
        grad_h, grad_W, z = torch.empty_like(h), torch.zeros_like(W), h.new_empty(S * k, len(W))
        z_by_group = z.view(S, k, -1)  # the same memory
        if grad_E_h is not None:  # the gradient of a row h through the moments: constant + h slope
            constant = grad_E_h / (B * S * k)
            slope = (grad_E_hh + grad_E_hh.t()) / (B * S * k)
        for b, rows in enumerate(h.reshape(B, S * k, D)):
            # The product, as in the forward pass
            torch.mm(rows, W.t(), out=z)
            # Overwrite it with the mask of the maxima: 1 for each maximum over k, otherwise 0
            torch.eq(z_by_group, z_by_group.amax(1, keepdim=True), out=z_by_group)
            # Overwrite the mask with the gradient of the product: equal maxima get equal shares
            z_by_group.mul_((grad[b] / z_by_group.sum(1).clamp_(min=1))[:, None])
            # The gradients of W and h
            grad_W.addmm_(z.t(), rows)
            grad_rows = grad_h[b].view(S * k, D)
            if grad_E_h is None:
                torch.mm(z, W, out=grad_rows)
            else:
                torch.addmm(constant, rows, slope, out=grad_rows).addmm_(z, W)
        return grad_h, grad_W, None


def linear_norm_relu_max(linear, norm, h):
    """The maximum over k of ReLU(BN(linear(h))): h (B,...,k,D) -> (B,...,D').

    ReLU is non-decreasing. BN is increasing in channels with a positive scale and decreasing in
    channels with a negative one. So the maximum can be taken first: of z = W h + b where the scale
    is positive, and of -z where it is negative. BN's statistics are still those of all neighbours.
    They follow from the moments of h: mean = W E[h] + b, var = diag(W Cov[h] W^T).
    """
    sign = torch.where(norm.weight < 0, -1.0, 1.0).to(h)
    W, b = sign[:, None] * linear.weight, sign * linear.bias
    groups = h.reshape(len(h), -1, *h.shape[-2:])  # (B,S,k,D)
    z, E_h, E_hh = LinearMax.apply(groups, W, norm.training)
    z = z.reshape(*h.shape[:-2], -1) + b  # (B,...,D')
    if norm.training:
        n = h[..., 0].numel()
        mean = W @ E_h + b
        var = ((W @ (E_hh - E_h[:, None] * E_h)) * W).sum(1).clamp(min=0)
        with torch.no_grad():  # the running statistics, as nn.BatchNorm1d updates them
            norm.num_batches_tracked.add_(1)
            momentum = norm.momentum
            if momentum is None:  # the running statistics are means over all batches
                momentum = 1 / norm.num_batches_tracked.item()
            norm.running_mean.lerp_(sign * mean, momentum)
            norm.running_var.lerp_(var * n / (n - 1), momentum)
    else:
        mean, var = sign * norm.running_mean, norm.running_var
    return F.relu((z - mean) * (norm.weight.abs() * torch.rsqrt(var + norm.eps)) + norm.bias)


# ------------------------------------------------------------------------------------------------
# 10  The commands train and eval

SIMULATED = Path("data/simulated")  # the simulated city, used without --data


def check_output(path, root):
    """Raise ValueError unless `path` can be a folder of results outside the data in `root`."""
    path, root = Path(path).resolve(), Path(root).resolve()
    if path.is_file():
        raise ValueError(f"--out {path} is a file; choose a folder")
    if path == root or any(path.is_relative_to(root / name) for name in ("sequences", "poses")):
        raise ValueError(f"--out {path} is inside the data folder; choose another folder")


def data_root(data, names, whole=False):
    """The folder `data` or, if it is None, that of the simulated city.

    Missing sequences of the city are simulated: those in `names`, or all if `whole`. Raises
    ValueError for a name that the city does not have.
    """
    if data:
        return Path(data)
    names = kitti.expand_splits(names or ())
    if unknown := set(names) - set(kitti.expand_splits("all")):
        raise ValueError(f"the simulated city has no sequence {' '.join(sorted(unknown))}; "
                         f"available: 00 to 10, {', '.join(SPLITS)}, all")
    return kitti.simulate(SIMULATED, sequences="all" if whole else names)


def choose_sequences(root, names=None):
    """Open the sequences to train on, and those of the test and validation splits. Two lists.

    names: sequences or splits to train on. None for the training split or, if `root` has nothing of
    it, for all sequences outside the test and validation splits. Raises ValueError if there is
    nothing to train on.
    """
    available, held_out = kitti.sequence_names(root), SPLITS["test"] + SPLITS["validation"]
    names = (names or [n for n in SPLITS["train"] if n in available]
             or [n for n in available if n not in held_out])
    if not names:
        raise ValueError(f"{root}: holds only test and validation sequences, "
                         f"{' '.join(available)}; choose those to train on with --sequences")
    chosen = kitti.open_sequences(root, names)
    chosen_names = [s.name for s in chosen]
    if not sum(len(s) - 1 for s in chosen):
        raise ValueError(f"{root}: sequence {' '.join(chosen_names)} has one scan; training needs "
                         "at least two scans")
    others = [n for n in held_out if n in available and n not in chosen_names]
    return chosen, kitti.open_sequences(root, others)


def train(config=None, data=None, sequences=None, out=None, seed=0, device="cpu", resume=False,
          weights=None, network=D3DLO, objective=None):
    """Run the command `train`: train a network, then evaluate it on the held-out sequences.

    config: a Config. None: the paper's settings or, for the simulated city, the short recipe.
    data: a folder in KITTI's layout. None: the simulated city.
    sequences: a list of names or splits to train on. None: see `choose_sequences`.
    out: the folder of the training run. None: a new one, runs/TIME.
    seed: random seed for initialisation, pair order and augmentation.
    device: cpu, cuda or mps.
    resume: continue the run in `out`. Its config, data, sequences, seed and weights are used again.
    weights: start from these weights and keep their network and input settings.
    network: the class of the network.
    objective: the loss, see `Training`.

    Returns the folder `out`. Raises ValueError if an argument or the data are invalid or the loss
    is not finite, and OSError if a file cannot be read or written.
    """
    check_device(device)
    check_number("seed", seed)
    run = kitti.unused_path("runs") if out is None else Path(out)
    check_output(run, data or SIMULATED)
    with kitti.run_folder(run):
        if resume:
            config, data, sequences, seed, weights = read_run(run)
        elif (run / "config.json").exists():
            raise ValueError(f"{run}: holds a training run; add --resume to continue it, or choose "
                             "another --out")
        config = config or (Config() if data else Config(**SHORT))
        data, weights = (path and str(Path(path).resolve()) for path in (data, weights))
        net, checkpoint, earlier = starting_point(run, resume, weights, config, network, seed)
        root = data_root(data, sequences, whole=True)
        chosen, held_out = choose_sequences(root, sequences)
        motions = [s.motions() for s in chosen]
        per_epoch = steps_per_epoch(motions, net.config)
        geometry, fingerprints, test = training_geometry(chosen, held_out, net.config)
        if checkpoint and checkpoint["train"] != fingerprints:
            raise ValueError(f"{run}: the data has changed since this training run started; "
                             "resume it with the data it was started with")
        facts = training_facts(fingerprints, motions, geometry, **earlier)
        names = list(fingerprints)
        arguments = dict(data=data, sequences=names, seed=seed, device=device, weights=weights)
        write_run(run, arguments, net.config)

        say = functools.partial(print_and_log, run / "log.txt")
        parameters, pairs = sum(p.numel() for p in net.parameters()), sum(map(len, motions))
        say(f"{parameters:,} parameters, {pairs:,} pairs of scans of {' '.join(names)}, "
            f"{net.config.epochs} epochs of {per_epoch} batches -> {run}")
        if not sequences and (missing := set(SPLITS["train"]) - set(names)):
            say(f"missing from the training split: {' '.join(sorted(missing))}")
        fit(net, geometry, motions, run, seed, device, checkpoint, say, objective, test, **facts)
        if held_out:
            evaluate_held_out(root, run, held_out, device, say, network)
        say(f"weights       {run}/weights.pt\n"
            f"next          python d3dlo.py eval --weights {run}{f' --data {data}' * bool(data)}")
    return run


def training_geometry(chosen, held_out, config):
    """Load the records of the sequences to train on, and the data for the test loss.

    Returns a list of records (n,), {name: fingerprint of the data}, and geometry and motions of the
    test split's sequences, or () if there are none. The scans of all held-out sequences are read,
    so that an unusable one is found now and not after the training.
    """
    geometry, fingerprints = load_geometry(chosen + held_out, config)
    test = [(records, s.motions()) for records, s in zip(geometry[len(chosen):], held_out)
            if s.name in SPLITS["test"] and s.poses is not None and len(s) > 1]
    names = [s.name for s in chosen]
    return geometry[:len(chosen)], dict(zip(names, fingerprints)), tuple(zip(*test))


def evaluate_held_out(root, run, held_out, device, say, network):
    """Evaluate the weights of a training run on the held-out sequences, into RUN/results."""
    names = [s.name for s in held_out]
    try:
        evaluate(root, run, names, run / "results", device, say=say, network=network)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"the weights are complete: {run}/weights.pt") from None


def print_and_log(log, line):
    """Print a line and append it to a log file."""
    with metrics.add_path_to_oserror(log), open(log, "a", encoding="utf-8") as file:
        file.write(line + "\n")
    print(line, flush=True)


def starting_point(run, resume, weights, config, network, seed):
    """What training starts from: the run's checkpoint, other weights, or random weights.

    Returns the network, the content of the checkpoint or None, and what `training_facts` must know
    about earlier training data. With other weights, the input settings stored in them are kept.
    """
    stored = run / "checkpoint.pt"
    if resume and stored.exists():
        net, checkpoint = load_weights(stored, network, checkpoint=True)
        return net, checkpoint, {"before": checkpoint["before"], "seen": checkpoint["seen"]}
    if weights:
        net, state = load_weights(weights, network)
        net.config = replace(net.config, **{name: getattr(config, name) for name in TRAINING})
        before = [*state["before"], *state["train"].values()]
        return net, None, {"before": before, "seen": state["seen"]}
    torch.manual_seed(seed)
    return network(config), None, {}


def training_facts(fingerprints, motions, geometry, before=(), seen=()):
    """Summarise the training data: what a weights file stores about them.

    fingerprints: {name of a sequence: fingerprint}.
    before, seen: the fingerprints and the range of scan statistics of earlier training data, if
        training starts from other weights.
    """
    stats = [records["stats"] for records in geometry]
    stats = np.concatenate([*stats, np.reshape(seen, (-1, len(kitti.STATS)))])
    return {"train": fingerprints,
            "before": sorted(set(before)),
            "mean_motion": to_vector(np.concatenate(motions)).mean(0).tolist(),
            "seen": [stats.min(0).tolist(), stats.max(0).tolist()]}


def write_run(run, arguments, config):
    """Write RUN/config.json: everything needed to repeat or resume a training run."""
    versions = kitti.versions(Path(__file__).parent) | {"d3dlo": __version__}
    content = {"arguments": arguments, "config": config.as_dict(), "versions": versions}
    metrics.write_json(run / "config.json", content)


def read_run(run):
    """Read RUN/config.json. Returns Config, data, sequences, seed and weights of the run."""
    try:
        content = json.loads((run / "config.json").read_text(encoding="utf-8"))
        config, arguments = Config(**content["config"]), content["arguments"]
        data, sequences, seed, weights = (arguments[name] for name in
                                          ("data", "sequences", "seed", "weights"))
        check_number("seed", seed)
        paths_are_sound = all(path is None or isinstance(path, str) for path in (data, weights))
        names_are_sound = type(sequences) is list and all(isinstance(n, str) for n in sequences)
        if not (paths_are_sound and names_are_sound):
            raise ValueError("damaged")
    except (ValueError, KeyError, TypeError, AttributeError, OSError):
        raise ValueError(f"{run}/config.json: missing or damaged, so there is no training run to "
                         "resume; give its folder with --out") from None
    return config, data, sequences, seed, weights


def evaluate(data=None, weights=None, sequences=None, out=None, device="cpu", refine=0, plot=False,
             say=print, network=D3DLO):
    """Run the command `eval`: write trajectories and results.json, and print a table of errors.

    data: a folder in KITTI's layout, or a plain folder of scans, which gives a trajectory only.
        None: the simulated city.
    weights: a weights file or the folder of a training run. None: the pretrained weights.
    sequences: a list of names or splits. None: all, or the simulated test and validation splits.
    out: the folder to write to. None: a new one, results/TIME.
    device: cpu, cuda or mps.
    refine: number of refinement passes, see `refine_pose`.
    plot: also draw OUT/plot.png.
    say: called with the text to print.
    network: the class of the network.

    Returns the folder `out`. Raises ValueError if an argument, the weights or the data are
    invalid, and OSError if a file cannot be read or written.
    """
    odometry = Odometry(weights, device, refine, network)
    if plot:
        metrics.new_figure(1, 1)  # without matplotlib, fail now and not after the work
    sequences = sequences or ("all" if data else ("test", "validation"))
    root = data_root(data, sequences)
    out = kitti.unused_path("results") if out is None else Path(out)
    check_output(out, root)
    chosen = kitti.open_sequences(root, sequences)
    is_folder = isinstance(chosen[0], kitti.ScanFolder)
    files = ["poses.txt", "poses.tum"] if is_folder else [f"{s.name}.txt" for s in chosen]
    for_server = {f"{i}.txt" for i in range(11, 22)} <= set(files)  # KITTI's without ground truth
    if for_server:
        files.append("kitti-server.zip")
    if plot:
        files.append("plot.png")
    check_results(out, files)
    source = {"weights": str(weights or PRETRAINED), "data": str(root), "refine": refine,
              "files": files}
    if is_folder:
        return evaluate_folder(odometry, chosen[0], out, source, say)

    results = evaluate_sequences(odometry, chosen, out, source)
    lines = [f"trajectories  {out}/NN.txt (KITTI pose files, rectified left camera frame)",
             f"errors        {out}/results.json"]
    if for_server:
        lines.append(f"to submit     {zip_for_server(out)}")
    if plot:
        T = {s.name: (s.poses_cam, metrics.read_poses(out / f"{s.name}.txt")) for s in chosen}
        metrics.draw(out / "plot.png", T)
        lines.append(f"plot          {out}/plot.png (from above, errors by length)")
    metrics.write_json(out / "results.json", source | results)
    say("\n".join([results_table(results), *lines]))
    return out


def evaluate_folder(odometry, s, out, source, say=print):
    """Predict the trajectory of a `kitti.ScanFolder`, with poses in the LiDAR's frame.

    Writes OUT/poses.txt, OUT/poses.tum and OUT/results.json. Returns the folder OUT.
    source: see `claim_results`.
    """
    (records,), _ = load_geometry([s], odometry.net.config)
    poses = predict_poses(odometry, s, records)
    claim_results(out, source)
    metrics.write_poses(out / "poses.txt", poses)
    kitti.write_tum(out / "poses.tum", poses, s.times)
    length = metrics.path_lengths(poses)[-1]
    lines = [f"{s.folder}: {len(s)} scans, path of {length:.1f} m",
             *(f"note          {note}" for note in s.notes),
             "frame         LiDAR at the first scan: x forward, y left, z up, in metres",
             f"trajectory    {out}/poses.txt (12 numbers a line, as in KITTI's pose files)",
             f"              {out}/poses.tum (t x y z qx qy qz qw, t in seconds)"]
    if "plot.png" in source["files"]:
        metrics.draw(out / "plot.png", {s.name: (None, poses)})
        lines.append(f"plot          {out}/plot.png (from above)")
    metrics.write_json(out / "results.json", source | {"path_m": length, "scans": len(s)})
    say("\n".join(lines))
    return out


def earlier_results(out):
    """The paths of the files in OUT that an earlier evaluation wrote, by OUT/results.json."""
    try:
        content = json.loads((out / "results.json").read_text(encoding="utf-8"))
        if not {"data", "refine", "files"} <= content.keys():  # not ours
            return []
        names = [name for name in content["files"] if Path(name).name == name]
    except (OSError, ValueError, TypeError, AttributeError):  # there is none, or it is not ours
        return []
    written = [name for name in names if Path(name).suffix in (".txt", ".tum", ".png", ".zip")]
    return [out / name for name in (*written, "results.json") if (out / name).is_file()]


def check_results(out, files):
    """Raise ValueError if an evaluation that writes `files` to OUT would replace other files."""
    earlier = earlier_results(out)
    for path in [out / name for name in (*files, "results.json")]:
        if path.exists() and path not in earlier:
            raise ValueError(f"{path} exists and is not from an earlier evaluation there: move it, "
                             "or choose another --out")


def claim_results(out, source):
    """Delete what an earlier evaluation wrote to OUT, and begin OUT/results.json with `source`.

    source: weights, data, refine, and the list of files that will be written. So these files are
    known to be ours even if the evaluation is interrupted.
    """
    for path in earlier_results(out):
        path.unlink()
    metrics.write_json(out / "results.json", source)


def zip_for_server(out):
    """Write OUT/kitti-server.zip, with 11.txt to 21.txt at its top level. Returns its path."""
    path = out / "kitti-server.zip"
    with metrics.replacing(path) as temporary:
        with zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive:
            for i in range(11, 22):
                archive.write(out / f"{i}.txt", f"{i}.txt")
    return path


def command_line(argv):
    """Parse the arguments. Returns {option: value} of the options given.

    The signatures of `train` and `evaluate` hold the defaults of all other options.
    """
    settings = dict(formatter_class=argparse.RawDescriptionHelpFormatter,
                    argument_default=argparse.SUPPRESS)
    parser = argparse.ArgumentParser(prog="d3dlo", **settings, description=(
        "D3DLO: Deep 3D LiDAR Odometry. Train the network and evaluate it.\n"
        "`train --help` and `eval --help` show all options, with examples."))
    parser.add_argument("--version", action="version", version=f"d3dlo {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="train | eval")
    train_options(commands.add_parser(
        "train", help="train, then evaluate on the test and validation splits", **settings,
        description=(
            "Train D3DLO, then evaluate it on the test and validation splits.\n\n"
            "  python d3dlo.py train\n"
            "  python d3dlo.py train --data ROOT\n"
            "  python d3dlo.py train --data ROOT --sequences 00 01 --short --epochs 20\n"
            "  python d3dlo.py train --data ROOT --weights d3dlo.pt --short --lr 0.002\n"
            "  python d3dlo.py train --out RUN --resume")))
    eval_options(commands.add_parser(
        "eval", **settings, help="predict trajectories and print KITTI's errors", description=(
            "Predict the trajectories of sequences, write them and print KITTI's errors.\n"
            "A plain folder of scans (*.bin or *.npy) gives a trajectory only.\n\n"
            "  python d3dlo.py eval\n"
            "  python d3dlo.py eval --data FOLDER --plot\n"
            "  python d3dlo.py eval --data ROOT --sequences test\n"
            "  python d3dlo.py eval --data ROOT --weights RUN --sequences 11 12")))
    return vars(parser.parse_args(argv))


def data_options(command, layouts, default):
    """Add the options of both commands. default: text on the default of --sequences, for --help."""
    add = command.add_argument_group("data").add_argument
    add("--data", metavar="ROOT", help=(
        f"{layouts} (default: a simulated city, made in {SIMULATED})"))
    add("--sequences", nargs="+", metavar="NN", help=(
        f"names, or splits: train, test, validation, all (default: {default})"))


def train_options(command):
    """Add the options of `train`."""
    data_options(command, "folder in KITTI odometry layout", "the training split")
    add = command.add_argument_group("network").add_argument
    add("--weights", metavar="FILE|RUN", help=(
        "start from these weights and keep their network and input settings"))
    add("--neighbors", type=int, metavar="N", help=(
        f"neighbours in the first set abstraction, n_n in Table 2 (default: {Config.sa1.n_n})"))
    add("--no-plane", action="store_false", dest="plane", help=(
        "remove the points of the ground plane, Table 2"))
    add = command.add_argument_group("training").add_argument
    add("--short", action="store_true", help=(
        "our short recipe, the default without --data: few epochs, points within 50 m, both "
        "directions, Muon, one-cycle learning rate, augmentation, fixed BatchNorm statistics at "
        "the end"))
    add("--epochs", type=int, metavar="N", help=(
        f"number of epochs (default: {Config.epochs}; with --short {SHORT['epochs']})"))
    add("--batch", type=int, metavar="N", help=(
        f"pairs in a batch (default: {Config.batch}; with --short {SHORT['batch']})"))
    add("--lr", type=float, metavar="X", help=(
        "initial (with --short, peak) learning rate "
        f"(default: {Config.lr}; with --short {SHORT['lr']})"))
    add("--seed", type=int, metavar="N", help=(
        "random seed for initialisation, pair order and augmentation (default: 0)"))
    add("--device", help="cpu, cuda or mps (default: cpu)")
    add = command.add_argument_group("run").add_argument
    add("--out", metavar="RUN", help="folder of the training run (default: runs/TIME)")
    add("--resume", action="store_true", help=(
        "continue the training run in --out with the options it was started with"))


def eval_options(command):
    """Add the options of `eval`."""
    data_options(command, "folder in KITTI odometry layout, or folder of scans",
                 "all; without --data, the test and validation splits")
    add = command.add_argument_group("network").add_argument
    add("--weights", metavar="FILE|RUN", help=(
        "weights, or the folder of a training run (default: the pretrained weights)"))
    add("--refine", type=int, metavar="N", help=(
        "not in the paper: refine each pose in N passes, each with its own sampling of the scan, "
        "the first against a keyframe, the others against the last scan; 3 is recommended "
        "(default: 0)"))
    add("--device", help="cpu, cuda or mps (default: cpu)")
    add = command.add_argument_group("results").add_argument
    add("--out", metavar="DIR", help=(
        "folder for NN.txt and results.json; replaces the results of an earlier evaluation there "
        "(default: results/TIME)"))
    add("--plot", action="store_true", help=(
        "draw the paths and the errors by length; needs matplotlib"))


def config_from(args):
    """The Config that the options of `train` describe. Removes these options from args.

    The default is the short recipe for the simulated city, and the paper's settings for other data.
    """
    if "weights" in args and args.keys() & {"neighbors", "plane"}:
        raise ValueError("--weights fixes the network and its input; do not combine it with "
                         "--neighbors or --no-plane")
    recipe = SHORT if args.pop("short", not args.get("data")) else {}
    given = {name: args.pop(name) for name in ("epochs", "batch", "lr", "plane") if name in args}
    sa1 = Config.sa1._replace(n_n=args.pop("neighbors", Config.sa1.n_n))
    return Config(**recipe | given, sa1=sa1)


def main(argv=None):
    """Run the command line. Returns the exit code: 0, 2 for bad input, 130 when interrupted."""
    args = command_line(argv)
    command = args.pop("command")
    kitti.keep_freed_memory()
    kitti.treat_sigterm_as_interrupt()
    try:
        if empty := [name for name, value in args.items() if value == ""]:
            raise ValueError(f"--{empty[0]} is empty; give a value, or leave the option out")
        if command == "eval":
            evaluate(**args)
        elif "resume" in args and args.keys() - {"resume", "out", "device"}:
            raise ValueError("--resume continues with the options the run was started with; give "
                             "only --out RUN and, if needed, --device")
        else:
            train(config_from(args), **args)
    except KeyboardInterrupt as interrupt:
        advice = str(interrupt) or "run the same command again"
        print(f"\nd3dlo: interrupted; {advice}", file=sys.stderr)
        return 130
    except BrokenPipeError:
        sys.stdout = open(os.devnull, "w")  # otherwise Python complains at exit
        advice = ("; continue with `python d3dlo.py train --out RUN --resume`"
                  if command == "train" else "")
        print(f"d3dlo: standard output was closed{advice}", file=sys.stderr)
        return 2
    except (ValueError, OSError) as error:
        print(f"d3dlo: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
