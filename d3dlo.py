"""D3DLO: Deep 3D LiDAR Odometry (Adis, Horst, Wien; ICIP 2021), a reference implementation.

The network takes two consecutive LiDAR scans P and Q and predicts the rigid motion between them.
Read this file beside the paper, from top to bottom:

    1  Table 1 and the settings               5  Odometry: eq. 1
    2  Sampling and grouping: 3.3.2, 3.3.3    6  Our additions: more augmentation, refinement
    3  The network: 3.3, eqs. 3 and 4         7  Evaluation: section 5
    4  Training: eq. 2, section 4             8  The commands train and eval

kitti.py loads or simulates the data, removes the ground plane (section 4) and converts motions to
the vectors of section 3.2. metrics.py computes E_t and E_r, eqs. 6 to 8. What the paper tried and
rejected is in benchmarks/experiments.py. docs/paper-differences.md lists where we differ from it.

Frame: Velodyne, x forward, y left, z up, in metres. T_ab maps points from frame b to frame a;
T_pq is the paper's T_{t,t+1}. Shapes: N points of a scan, n of a layer's input, S centroids, k
neighbours, c features, C scans in a batch, B pairs of them; n1 to n3 and k1 to k3 are n_fps and n_n
of SA1 to SA3. (The paper's n_1 and n_2 are the numbers of points of P and Q.)

    python d3dlo.py train                       # on a simulated city; 15 minutes on a CPU
    python d3dlo.py train --data ROOT           # on KITTI odometry, with the paper's settings
    python d3dlo.py eval --data ROOT            # with the pretrained weights
"""
import os

# Set before PyTorch is loaded, so that its idle threads sleep. Spinning ones slow a busy machine.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import argparse
import copy
import functools
import io
import itertools
import json
import math
import numbers
import pickle
import shutil
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

__version__ = "0.3.0"

# ------------------------------------------------------------------------------------------------
# 1  Table 1 and the settings of section 4


class Layer(NamedTuple):
    """A row of Table 1; None where the table has a dash."""

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
    batch: int = 16  # pairs of scans in a batch; those left over join the others
    optimizer: str = "adam"  # the paper's; or ours, "muon": Muon for the hidden layers
    lr: float = 1e-3  # learning rate: Adam's default; with "one-cycle" the peak
    schedule: str = "steps"  # lr / 10 (factor ours) after 3/5 and 4/5 of the steps; or "one-cycle"
    augment: bool = False  # ours, beyond section 4's swap: mirror pairs, move Q, align some pairs
    frozen: float = 0.0  # ours: train this last share of the steps with fixed BatchNorm statistics

    def __post_init__(self):
        # A round trip through JSON turns NumPy's numbers into Python's, and Layers into lists. Turn
        # the lists back. (An immutable class needs object.__setattr__.)
        text = json.dumps(vars(self), default=lambda x: getattr(x, "item", x.__repr__)())
        for name, value in json.loads(text).items():
            if isinstance(getattr(Config, name), Layer):
                *rest, widths = value
                value = Layer(*rest, tuple(widths))
            object.__setattr__(self, name, value)
        check_config(self)

    def as_dict(self):
        """A dict that JSON can hold. `Config(**d)` is the inverse."""
        return json.loads(json.dumps(asdict(self)))


def require(name, values, low, high):
    """Raise a ValueError that names a number out of bounds. Integer bounds require integers."""
    kind = numbers.Integral if isinstance(low, int) else numbers.Real
    for x in values:
        if isinstance(x, bool) or not isinstance(x, kind) or not low <= x <= high:
            what = "an integer" if kind is numbers.Integral else "a number"
            raise ValueError(f"{name} is {x!r}, but must be {what} from {low} to {high}")


def check_config(config):
    """Raise a ValueError that names the invalid setting."""
    sa = [config.sa1, config.sa2, config.sa3]
    grouping = [*sa, config.fe]
    widths = [layer.widths for layer in (*grouping, config.mpn, config.mlp)]
    require("r", [layer.r for layer in sa], 1e-3, 1e3)
    require("n_fps", [layer.n_fps for layer in sa], 1, 65535)
    require("n_fps of sa2", [config.sa2.n_fps], 1, config.sa1.n_fps)
    require("n_fps of sa3", [config.sa3.n_fps], 1, config.sa2.n_fps)
    require("n_n", [layer.n_n for layer in grouping], 1, 1024)
    require("number of widths", map(len, widths), 2, 16)
    require("width", itertools.chain(*widths), 1, 1024)
    require("max_range", [] if config.max_range is None else [config.max_range], 1e-3, 1e3)
    require("epochs", [config.epochs], 1, 10**9)
    require("batch", [config.batch], 1, 10**6)
    require("lr", [config.lr], 1e-12, 1e3)
    require("frozen", [config.frozen], 0.0, 0.999)
    if config.mlp.widths[-1] != 6:
        raise ValueError("the last width of mlp must be 6: translation and angles")
    for name, choices in dict(plane=(True, False), augment=(True, False),
                              optimizer=("adam", "muon"), schedule=("steps", "one-cycle")).items():
        if getattr(config, name) not in choices:
            raise ValueError(f"{name} is {getattr(config, name)!r}, but must be "
                             f"{choices[0]} or {choices[1]}")


# Our short recipe: a quarter of an hour on the simulated city
SHORT = dict(max_range=50.0, epochs=18, batch=16, optimizer="muon", lr=1e-2, schedule="one-cycle",
             augment=True, frozen=0.25)

# ------------------------------------------------------------------------------------------------
# 2  Sampling and grouping: sections 3.3.2 and 3.3.3


def farthest_point_sampling(xyz: np.ndarray, n: int) -> np.ndarray:
    """Farthest point sampling: each new centroid is the point farthest from its nearest centroid.

    xyz (N,3), finite -> indices (n,) int64 of the centroids. The first is point 0. Of equally far
    points the one with the smallest x is taken. The result is nested: its first m indices are the
    result for n = m. Raises ValueError unless 0 < n <= N.

    The trick: let r be the distance of the new centroid from its nearest earlier one. No point is
    farther than r from its nearest centroid, so the new one can be nearer only to points within r
    of itself. Sorted by x, they lie in a slice.
    """
    if not 0 < n <= len(xyz):
        raise ValueError(f"cannot sample {n} of {len(xyz)} points")
    order = np.argsort(xyz[:, 0], kind="stable")
    points = np.ascontiguousarray(xyz[order].T)  # (3,N)
    min_dist = np.full(len(xyz), np.inf, points.dtype)  # squared distance to the nearest centroid
    centroids = np.empty(n, np.int64)
    j = order.argmin()  # the place of point 0
    for i in range(n):
        centroids[i] = order[j]
        p, r = points[:, j], np.nextafter(np.sqrt(min_dist[j]), np.inf)  # rounded up
        near = slice(points[0].searchsorted(p[0] - r, "left"),
                     points[0].searchsorted(p[0] + r, "right"))
        d = points[:, near] - p[:, None]  # (3,points near)
        d *= d
        d[0] += d[1]
        d[0] += d[2]
        np.minimum(min_dist[near], d[0], out=min_dist[near])
        j = min_dist.argmax()
    return centroids


def group_ball(xyz: np.ndarray, centroids: np.ndarray, r: float, n_n: int, tree=None) -> np.ndarray:
    """The neighbours i of each centroid j in eq. 3: the nearest n_n points with |x_i - x'_j| <= r.

    xyz (N,3) in metres, centroids (S,) indices into xyz -> (S,n_n) indices, nearest first. The
    first one is the centroid itself, or a point at the same place, so no ball is empty. The
    centroid also fills the places of missing neighbours. Its copies leave the maximum in eq. 3
    unchanged but do affect the statistics of batch normalisation. tree: cKDTree(xyz), if known.
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


def record_dtype(config):
    """The dtype of a record, one sampled scan: what the network needs of it, and facts about it."""
    n1, n2, n3 = config.sa1.n_fps, config.sa2.n_fps, config.sa3.n_fps
    return np.dtype([
        ("xyz", "f4", (n1, 3)),  # centroids of SA1 [m]; the first n2 are SA2's, the first n3 SA3's
        ("group_sa1", "f4", (n1, config.sa1.n_n, 4)),  # SA1's neighbours: f_i, x_i - x'_j [m]
        ("idx_sa2", "u2", (n2, config.sa2.n_n)),  # SA2's neighbours, indices into SA1's centroids
        ("idx_sa3", "u2", (n3, config.sa3.n_n)),  # SA3's neighbours, indices into SA2's centroids
        ("stats", "f4", len(kitti.STATS)),  # scan statistics, to warn about domain shift
        ("invalid", "i4"),  # number of invalid points that were dropped
        ("crc", "u4"),  # CRC-32 of the scan, filled in by `record_of_file`
    ])


def scan_records(scan: np.ndarray, config: Config = Config(), n: int = 1) -> np.ndarray:
    """Sample and group a scan n times for all three set abstractions: (N,4) -> records (n,).

    scan: x, y, z [m] in the Velodyne frame, and intensity 0 to 1. Nothing is learned here, so a
    record is computed once for every scan and kept. Refinement (part 6) uses n > 1: record k takes
    its centroids from every n-th usable point, starting with point k, so no two records share a
    centroid. With fewer than n * n1 points there are fewer such samplings, and records repeat.
    Raises ValueError if too few points are usable.
    """
    scan, invalid = kitti.usable_points(scan, config.max_range, config.plane)
    sa1, sa2, sa3 = config.sa1, config.sa2, config.sa3

    def require_enough(count):
        if count < sa1.n_fps:
            reach = config.max_range or kitti.MAX_VALID_RANGE
            raise ValueError(f"{count} different usable points (finite, within {reach:.0f} m"
                             f"{'' if config.plane else ', off the ground'}), but the network "
                             f"needs {sa1.n_fps}; are the coordinates in metres?")

    require_enough(len(scan))
    cloud = np.ascontiguousarray(scan[:, :3])
    tree = cKDTree(cloud, leafsize=48, balanced_tree=False, compact_nodes=False)  # fast to build
    parts = min(n, len(cloud) // sa1.n_fps)
    records = np.zeros(n, record_dtype(config))
    for k, record in enumerate(records):
        part = k % parts
        centroids = farthest_point_sampling(cloud[part::parts], sa1.n_fps)  # (n1,)
        centroids = part + parts * centroids  # indices into cloud
        neighbours = group_ball(cloud, centroids, sa1.r, sa1.n_n, tree)  # (n1,k1)
        record["xyz"] = xyz = cloud[centroids]  # (n1,3)
        require_enough(len(np.unique(xyz, axis=0)))
        record["group_sa1"][..., 0] = scan[neighbours, 3]  # (n1,k1)
        record["group_sa1"][..., 1:] = cloud[neighbours] - xyz[:, None]  # (n1,k1,3)
        # One sampling serves all layers. Farthest point sampling of SA1's centroids would choose
        # them in the same order again, so SA2's are the first n2 of them, and SA3's the first n3.
        first_n2, first_n3 = np.arange(sa2.n_fps), np.arange(sa3.n_fps)
        record["idx_sa2"] = group_ball(xyz, first_n2, sa2.r, sa2.n_n)  # (n2,k2)
        record["idx_sa3"] = group_ball(xyz[first_n2], first_n3, sa3.r, sa3.n_n)  # (n3,k3)
        record["stats"], record["invalid"] = kitti.scan_stats(scan, xyz), invalid
    return records


class Batch(NamedTuple):
    """The network's input: C scans and B pairs (P, Q) of them. A scan may be in several pairs."""

    xyz: torch.Tensor  # (C,n1,3) centroids [m]
    group_sa1: torch.Tensor  # (C,n1,k1,4) f_i, x_i - x'_j [m]
    idx_sa2: torch.Tensor  # (C,n2,k2)
    idx_sa3: torch.Tensor  # (C,n3,k3)
    p: torch.Tensor  # (B,) index of P among the scans
    q: torch.Tensor  # (B,) index of Q among the scans
    idx_fe: torch.Tensor  # (B,n1,k) neighbours in Q of each centroid of P


def make_batch(records, p, q, config, device="cpu"):
    """Records (C,) and index arrays p, q (B,) -> Batch. Torch needs int64 indices."""
    idx_sa2, idx_sa3 = records["idx_sa2"].astype(np.int64), records["idx_sa3"].astype(np.int64)
    arrays = records["xyz"], records["group_sa1"], idx_sa2, idx_sa3, p, q
    tensors = [torch.from_numpy(np.ascontiguousarray(array)).to(device) for array in arrays]
    return Batch(*tensors, neighbours_in_q(tensors[0], p, q, config.fe.n_n))


def neighbours_in_q(xyz, p, q, k):
    """`group_knn` for every pair: centroids xyz (C,n1,3) and index arrays p, q (B,) -> (B,n1,k)."""
    if xyz.device.type == "cpu":
        xyz = xyz.numpy()
        return torch.from_numpy(np.stack([group_knn(xyz[j], xyz[i], k) for i, j in zip(p, q)]))
    # On a GPU, a matrix of all distances avoids waiting for the CPU. (The mode of cdist that
    # multiplies matrices is too inaccurate.)
    distances = torch.cdist(xyz[p], xyz[q], compute_mode="donot_use_mm_for_euclid_dist")
    idx = distances.topk(min(k, xyz.shape[1]), largest=False).indices  # nearest first
    repeated = idx[..., :1].expand(-1, -1, k - idx.shape[2])
    return torch.cat([idx, repeated], 2)


# ------------------------------------------------------------------------------------------------
# 3  The network: section 3.3


def mlp_layers(c, widths):
    """An MLP such as h in eqs. 3 and 4. For each width: linear, batch normalisation, ReLU."""
    layers = []
    for c_in, c_out in itertools.pairwise((c, *widths)):
        layers += [nn.Linear(c_in, c_out), nn.BatchNorm1d(c_out), nn.ReLU(inplace=True)]
    return nn.Sequential(*layers)


class MiniPointNet(nn.Module):
    """Section 3.3.1: the same MLP h for every point, then the maximum over the points."""

    def __init__(self, c, widths):
        super().__init__()
        self.h = mlp_layers(c, widths)

    def forward(self, f):
        """max_i h(f_i): features f (...,k,c) of k points -> (...,c')."""
        return self.after_first_layer(self.h[0](f))

    def over_neighbours(self, a, b, idx):
        """max h(a_m + b_s) over the neighbours m of each s, given by idx (B,S,k).

        a (B,n,c), b (B,S,c) -> (B,S,c'). The trick: h's first layer is linear, with weight W and
        bias w, so W (a_m + b_s) + w = W a_m + (W b_s + w). W is applied to n + S rows before the
        neighbours are gathered, and not to S k rows afterwards.
        """
        u = F.linear(a, self.h[0].weight)  # (B,n,c1)
        v = self.h[0](b)  # (B,S,c1)
        # The neighbours' rows in the flattened batch
        rows = idx + a.shape[1] * torch.arange(len(a), device=a.device)[:, None, None]
        u_m = u.flatten(0, 1).index_select(0, rows.flatten()).view(*idx.shape, -1)  # (B,S,k,c1)
        return self.after_first_layer(u_m + v[:, :, None])

    def after_first_layer(self, z):
        """The output z (...,k,c1) of h's first layer -> the maximum of h's output (...,c')."""
        *sets, k, _ = z.shape
        points = self.h[1:-1](z.flatten(0, -2))  # (points,c'): all points share the MLP
        # The maximum over each set, as a row of an image. (The backward pass of amax is slow.)
        image = points.view(1, -1, k, points.shape[1]).movedim(3, 1)  # (1,c',sets,k)
        maximum = F.max_pool2d(image, (1, k)).movedim(1, 3)  # (1,sets,1,c')
        # ReLU is non-decreasing, so the last one may come after the maximum
        return F.relu(maximum).view(*sets, -1)


class SetAbstraction(nn.Module):
    """Section 3.3.2, eq. 3: f'_j = max_i h_sa(f_i, x_i - x'_j) over the neighbours i of j."""

    def __init__(self, c, layer):
        super().__init__()
        self.mpn = MiniPointNet(c + 3, layer.widths)

    def forward(self, x, f, idx):
        """x (B,n,3), f (B,n,c), idx (B,S,k) -> f' (B,S,c'). The first S points are centroids."""
        # [f_i, x_i - x'_j] = [f_i, x_i] + [0, -x'_j]
        a = torch.cat([f, x], -1)  # (B,n,c+3)
        b = F.pad(-x[:, :idx.shape[1]], (f.shape[2], 0))  # (B,S,c+3)
        return self.mpn.over_neighbours(a, b, idx)


class FlowEmbedding(nn.Module):
    """Section 3.3.3, eq. 4: e_i = max_j h_fe(f_i, g_j, y_j - x_i) over i's neighbours j in Q."""

    def __init__(self, c, layer):
        super().__init__()
        self.mpn = MiniPointNet(2 * c + 3, layer.widths)

    def forward(self, x, f, y, g, idx):
        """P: x (B,S,3), f (B,S,c); Q: y (B,n,3), g (B,n,c); idx (B,S,k) -> e (B,S,c')."""
        # [f_i, g_j, y_j - x_i] = [0, g_j, y_j] + [f_i, 0, -x_i]; j is a neighbour of i
        a = torch.cat([torch.zeros_like(g), g, y], -1)  # (B,n,2c+3)
        b = torch.cat([f, torch.zeros_like(f), -x], -1)  # (B,S,2c+3)
        return self.mpn.over_neighbours(a, b, idx)


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
        # SA1 for every scan, eq. 3. Its inputs [f_i, x_i - x'_j] were gathered in `scan_records`,
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

CHECKPOINT_EVERY, WEIGHTS_EVERY = 60.0, 300.0  # seconds


def training_batch(data, pairs, config, rng=None, device="cpu"):
    """Load n pairs of scans, swapped at random -> Batch, and the motions T_pq (n,4,4) to predict.

    data: see `fit`; pairs: (n,2), the index s of the sequence and i of the scan P; Q is scan i + 1.
    With augmentation, some pairs imitate refinement (part 6): Q may be several scans later, and is
    aligned with P up to a small motion. rng: None to neither augment nor swap the pairs.
    """
    n, augmented = len(pairs), config.augment and rng
    aligned = rng.random(n) < ALIGNED if augmented else np.zeros(n, bool)
    scans_p, scans_q, T_pq = [], [], []
    for (s, i), is_aligned in zip(pairs, aligned):
        records, motions = data[s]
        j = later_scan(motions, i, rng) if is_aligned else i + 1
        scans_p.append(records[i])
        scans_q.append(records[j])
        T_pq.append(functools.reduce(np.matmul, motions[i:j]))  # T_{i,i+1} ... T_{j-1,j}
    scans, T_pq = np.stack(scans_p + scans_q), np.stack(T_pq)  # all P, then all Q
    if augmented:
        scans, T_pq = augment(scans, T_pq, aligned, rng)
    p, q = np.arange(n), np.arange(n, 2 * n)
    if rng:  # section 4: swap P and Q at random, and invert the motion
        swap = rng.random(n) < 0.5
        p, q = np.where(swap, q, p), np.where(swap, p, q)
        T_pq = np.where(swap[:, None, None], invert(T_pq), T_pq)
    return make_batch(scans, p, q, config, device), T_pq


def all_pairs(data):
    """All pairs of consecutive scans (pairs,2): the index of the sequence and of the first scan."""
    return np.array([(s, i) for s, (_, motions) in enumerate(data) for i in range(len(motions))])


def steps_per_epoch(pairs, config):
    """Number of batches in an epoch of `pairs` pairs: pairs // batch, at least 1.

    Raises ValueError if a batch would hold one pair: the final MLP sees one row per pair, so batch
    normalisation would have no statistics.
    """
    if min(pairs, config.batch) < 2:
        raise ValueError(f"batch size {config.batch} with {pairs} training pairs (consecutive "
                         "scans): batch normalisation needs at least 2 pairs per batch")
    return max(1, pairs // config.batch)


def batches(data, config, seed, start, stop, device="cpu"):
    """Yield training batches `start` to `stop` - 1. A thread prepares the next one meanwhile.

    A batch depends only on `seed` (a tuple) and its number, so an interrupted training run
    continues with the batches it would have seen.
    """
    pairs = all_pairs(data)
    per_epoch = steps_per_epoch(len(pairs), config)

    def prepare(step):
        epoch, part = divmod(step, per_epoch)
        order = np.random.default_rng([*seed, epoch]).permutation(len(pairs))
        chosen = np.array_split(order, per_epoch)[part]  # parts of nearly equal size
        # part + 1, since NumPy treats the seeds [*seed, epoch] and [*seed, epoch, 0] alike
        rng = np.random.default_rng([*seed, epoch, part + 1])
        return training_batch(data, pairs[chosen], config, rng, device)

    if start == stop:
        return
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
    """Learning rate decays at epochs 300 and 400 of 500 (section 4), or PyTorch's one-cycle, which
    also cycles the momentum.
    """
    if config.schedule == "one-cycle":
        return torch.optim.lr_scheduler.OneCycleLR(optimizer, config.lr, total_steps=steps)
    decays = [max(1, steps * 3 // 5), max(1, steps * 4 // 5)]  # 300/500 and 400/500
    return torch.optim.lr_scheduler.MultiStepLR(optimizer, decays, gamma=0.1)


def loss_of(net, objective, batch, T):
    """The loss () of a Batch with the true motions T (B,4,4)."""
    y = torch.from_numpy(net.encode(T).astype(np.float32)).to(batch.xyz.device)  # (B,6)
    return objective(net(batch), y)


@torch.inference_mode()
def held_out_loss(net, objective, data, device):
    """Mean loss on 500 evenly spaced pairs, or on all if fewer."""
    pairs = all_pairs(data)
    chosen = pairs[np.unique(np.linspace(0, len(pairs) - 1, 500).astype(int))]
    parts = np.array_split(chosen, math.ceil(len(chosen) / 16))
    return np.mean([loss_of(net, objective, *training_batch(data, part, net.config, None, device))
                    .item() for part in parts])


def fit(net, data, run, test=(), seed=0, device="cpu", objective=None, checkpoint=None, say=print,
        **facts):
    """Train `net` in place as `net.config` says (section 4), and write RUN/weights.pt.

    data: for each sequence a tuple of its records (n,) and its T_{t,t+1} (n-1,4,4).
    test: the same for the test sequences. Their loss is reported after every epoch, and used for
        nothing else.
    seed: random seed for the order of the pairs, their directions and augmentation.
    objective: a module (y_hat, y) -> loss. None: eq. 2.
    checkpoint: the content of RUN/checkpoint.pt, to continue from it.
    say: called with each line to report.
    facts: values to store with the weights: all that `training_facts` returns.

    RUN/checkpoint.pt holds all that a step changes, and a batch depends on the seed and its number
    alone. So on the same CPU and with as many threads, a resumed run ends with the same
    weights, bit for bit. Raises ValueError if the loss, a weight or a statistic is not finite;
    nothing is stored from then on.
    """
    # Eq. 2 is the mean absolute error of all six outputs, metres and degrees alike
    objective = (objective or nn.L1Loss()).to(device)
    config, run, net = net.config, Path(run), net.to(device)
    per_epoch = steps_per_epoch(len(all_pairs(data)), config)
    steps = config.epochs * per_epoch
    frozen_from = round(steps * (1 - config.frozen))  # from this step on, statistics are fixed
    optimizers = make_optimizers(net, objective)
    schedulers = [make_scheduler(optimizer, config, steps) for optimizer in optimizers]
    parts = [net, objective, *optimizers, *schedulers]  # all that a step changes
    step, losses = 0, []  # losses of this epoch
    if checkpoint:
        with reading_weights(run / "checkpoint.pt", NEW_START):
            step, losses = checkpoint["step"], checkpoint["losses"]
            for part, state in zip(parts, checkpoint["parts"], strict=True):
                part.load_state_dict(state)
            require("step", [step], 0, steps)

    def update_statistics(net):  # with batches of their own: no epoch has the number 2**31
        update_bn(batches(data, config, (seed, 2**31), 0, min(25, steps), device), net)

    def inference_copy():  # running statistics lag behind the weights, so they are updated
        trained = copy.deepcopy(net)
        if step <= frozen_from:
            update_statistics(trained)
        return trained.eval()

    def require_finite(x, name):
        if not math.isfinite(x):
            raise ValueError(f"{run}: {name} became non-finite at step {step} (learning rate "
                             f"{rate:.1e}); the last checkpoint, if any, was kept. Start anew "
                             "with a lower learning rate")

    def store(name, net, **content):
        tensors = [*net.state_dict().values(), *objective.parameters()]
        total = sum(tensor.double().sum().item() for tensor in tensors)
        require_finite(total, "a weight or BatchNorm statistic")
        save(run / name, step=step, config=config.as_dict(), **content, **facts)

    checkpoint_stored = weights_stored = time.monotonic()
    examples = batches(data, config, (seed,), step, steps, device)  # in random order, swapped
    for batch, T in progress(examples, steps - step, "training, batches"):
        if step == frozen_from:
            update_statistics(net)
        net.train(step < frozen_from)
        rate = schedulers[0].get_last_lr()[0]
        loss = loss_of(net, objective, batch, T)
        require_finite(loss.item(), "the loss")
        net.zero_grad()
        objective.zero_grad()
        loss.backward()
        for part in (*optimizers, *schedulers):
            part.step()
        losses.append(loss.item())
        step += 1

        now = time.monotonic()
        if step % per_epoch == 0:
            line = f"epoch {step // per_epoch}/{config.epochs}: loss {np.mean(losses):.4f}"
            if test:
                test_loss = held_out_loss(inference_copy(), objective, test, device)
                require_finite(test_loss, "the test loss")
                line += f", test loss {test_loss:.4f}"
            say(f"{line}, learning rate {rate:.1e}")
            losses = []
        if step == steps or now - weights_stored > WEIGHTS_EVERY:
            trained = inference_copy()
            store("weights.pt", trained, model=trained.state_dict())
            weights_stored = now
        if step == steps or now - checkpoint_stored > CHECKPOINT_EVERY:
            states = [part.state_dict() for part in parts]
            store("checkpoint.pt", net, losses=losses, parts=states)
            checkpoint_stored = now


PRETRAINED = Path(__file__).with_name("d3dlo.pt")


def save(path, **content):
    """Write weights or a checkpoint: state_dicts and plain values. Raises OSError on failure."""
    file = io.BytesIO()  # in memory first: torch raises a RuntimeError if the disk is full
    torch.save(content, file)
    with metrics.replacing(path) as temporary:
        temporary.write_bytes(file.getbuffer())


NEW_START = "delete it to train from the start"


@contextmanager
def reading_weights(path, remedy="give a weights.pt or the folder of a training run"):
    """Turn every exception into a ValueError with one line about the file and the remedy."""
    try:
        yield
    except Exception as error:  # torch and pickle raise many exception types for a bad file
        reason = f"{type(error).__name__}: {error}".splitlines()[-1].strip()
        if isinstance(error, pickle.UnpicklingError):  # torch's own text is long
            reason = "it is damaged, or holds Python objects, which are not loaded for safety"
        raise ValueError(f"{path}: cannot be read as D3DLO weights ({reason:.120}); "
                         f"{remedy}") from None


def read_archive(path):
    """The content of a weights file or checkpoint, a dict. Code in the file is never run."""
    with zipfile.ZipFile(path) as archive:
        if any(entry.compress_type for entry in archive.infolist()):  # torch never compresses
            raise ValueError("compressed")
        if archive.testzip():  # torch does not verify the archive's checksums
            raise ValueError("damaged")
    return dict(torch.load(path, map_location="cpu", weights_only=True))


def build(network, config):
    """A new network, whatever torch's default dtype and device are."""
    with torch.device("cpu"):
        return network(config).float()


def load_weights(path: str | Path | None = None, network=D3DLO):
    """Read a weights file. Returns the network, in eval mode, and the content of the file, a dict.

    path: the file, or the folder of a training run. None: the pretrained weights.
    network: the class of the network, which is built from the settings in the file.

    Raises FileNotFoundError if there is no such file, and ValueError if it is damaged or of another
    kind.
    """
    path = Path(PRETRAINED if path is None else path)
    path = path / "weights.pt" if path.is_dir() else path
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; give a weights.pt or the folder of a "
                                "training run, as `python d3dlo.py train` writes them")
    with reading_weights(path):
        state = read_archive(path)
        if "parts" in state:
            raise ValueError("it is a checkpoint, which only --resume can use")
        net = build(network, Config(**state["config"]))
        net.load_state_dict(state["model"])
        (low, high), motion = state["seen"], state["mean_motion"]
        if not (np.isfinite([*low, *high, *motion]).all() and len(motion) == 6
                and len(low) == len(high) == len(kitti.STATS)
                and all(isinstance(fingerprint, str) for fingerprint in state["trained_on"])):
            raise ValueError("damaged")
    return net.eval(), state


# ------------------------------------------------------------------------------------------------
# 5  Odometry: eq. 1


def accumulate(motions):
    """Motions (n-1,4,4) -> poses (n,4,4) by eq. 1, T_{0,t+1} = T_{0,t} T_{t,t+1}.

    The first pose is the identity.
    """
    return np.stack([*itertools.accumulate(motions, np.matmul, initial=np.eye(4))])


@torch.inference_mode()
def predict(net, records, p, q, device):
    """Records (C,) and index arrays p, q (B,) -> T_pq (B,4,4), in one forward pass."""
    y_hat = net(make_batch(records, p, q, net.config, device)).cpu().numpy()
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


INVALID_POINTS = "invalid points (not finite, or range or intensity out of bounds)"
SHIFT_WARNING = "scans look unlike the training data; the poses may be wrong"


class Odometry:
    """Poses from a stream of scans: `Odometry().register(scan)`.

    weights: a weights file or the folder of a training run. None: the pretrained weights.
    device: cpu, cuda or mps. network: the class of the network.
    refine: number of refinement passes, see `refine_pose`. 0: the paper's plain prediction.

    Raises ValueError if an argument or the weights are invalid, and FileNotFoundError if there is
    no such weights file.
    """

    def __init__(self, weights: str | Path | None = None, device: str = "cpu", refine: int = 0,
                 network=D3DLO):
        check_device(device)
        require("refine", [refine], 0, 100)  # the time of a scan grows with it
        net, self.facts = load_weights(weights, network)
        self.net, self.device, self.refine = net.to(device), device, refine
        self.restart()

    def restart(self):
        """Forget all scans. The next one defines the frame of the poses."""
        self.warned = set()  # the kinds of warnings that were given
        self.last = self.keyframe = None  # records and pose of the last scan and of a keyframe

    def register(self, scan: np.ndarray) -> np.ndarray:
        """Scan (N,4): x, y, z [m], intensity 0 to 1 -> its pose T_0t (4,4), Velodyne frame.

        The first pose is the identity. Warns of invalid points and of scans unlike those in
        training, once each until `restart`. Raises ValueError if the scan cannot be used; the state
        is then unchanged.
        """
        records = scan_records(scan, self.net.config, max(self.refine, 1))
        invalid = records["invalid"][0]
        shift = kitti.domain_shift(records["stats"][0], self.facts["seen"])
        for kind, found, text in (("points", invalid, f"dropped {invalid} {INVALID_POINTS}"),
                                  ("shift", shift, f"{SHIFT_WARNING}: {shift}")):
            if found and kind not in self.warned:
                self.warned.add(kind)
                warnings.warn(text, stacklevel=2)
        return self.register_records(records)

    def register_records(self, records):
        """`register` for a scan that is sampled already: records (max(refine, 1),) -> its pose."""
        pose = np.eye(4)
        if self.last:
            last_records, last_pose = self.last
            pair = np.stack([last_records[0], records[0]])
            T_pq, = predict_motions(self.net, pair, self.device)
            pose = last_pose @ T_pq  # eq. 1
        # Refine the pose: first with a keyframe, an earlier scan that is replaced every few metres,
        # then with the last scan. The keyframe limits how fast errors add up from scan to scan.
        if self.refine and self.keyframe:
            references = [self.keyframe] + [self.last] * (self.refine - 1)
            pose = refine_pose(self.net, references, records, pose, self.device)
        if self.refine and (not self.keyframe or is_far(invert(self.keyframe[1]) @ pose)):
            self.keyframe = records, pose
        self.last = records, pose
        return pose.copy()  # the caller may change it


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
# 6  Our additions, not in the paper: more augmentation, and refinement

ALIGNED = 1 / 3  # with augmentation, the share of pairs in which Q is first aligned with P
KEYFRAME_DISTANCE, KEYFRAME_ANGLE = 5.0, 20.0  # [m], [deg] at which refinement takes a new keyframe


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


def augment(scans, T_pq, aligned, rng):
    """Mirror pairs left to right with probability 1/2, then move every Q by a small random motion.

    scans: records (2n,), first of n scans P and then of their n scans Q. T_pq: (n,4,4). Returns
    both after augmentation. Where `aligned` (n,) is true, Q is first aligned with P by T_pq. A
    motion A that takes each point q of Q to A q turns T_pq into T_pq A^-1.
    """
    n = len(T_pq)
    mirror = np.where(rng.random((n, 1, 1)) < 0.5, np.diag([1.0, -1, 1, 1]), np.eye(4))
    T_pq = mirror @ T_pq @ mirror
    # Standard deviations [m], [deg]; the angle is largest in yaw, since turns are rare
    scale = [0.25, 0.1, 0.03, 0.1, 0.1, 1.0]
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
    T = np.mean(transforms, axis=0)
    T[:3, :3] = Rotation.from_matrix(np.stack(transforms)[:, :3, :3]).mean().as_matrix()
    return T


def refine_pose(net, references, records, pose, device):
    """Refine the pose T_0q (4,4) of a scan Q with n samplings, records (n,). Returns T_0q.

    references: a list of n pairs (records (n,), pose T_0p), an earlier scan P for each pass.
    Pass k uses sampling k of both scans. It aligns Q with P using the current estimate, predicts
    the residual motion in both directions, and updates the estimate. The result is the mean of all
    n estimates, because most of their error depends on which points were sampled.
    """
    estimates = []
    for k, (records_p, T_0p) in enumerate(references):
        T = invert(T_0p) @ pose  # the current estimate of T_pq
        aligned, = move_scans(records[k][None], T[None])
        pair = np.stack([records_p[k], aligned])
        T_pq, T_qp = predict(net, pair, np.array([0, 1]), np.array([1, 0]), device)
        pose = T_0p @ mean_transform([T_pq, invert(T_qp)]) @ T
        estimates.append(pose)
    return mean_transform(estimates)


def is_far(T):
    """Whether a scan at the pose T (4,4) relative to the keyframe becomes the next keyframe."""
    angle = np.degrees(Rotation.from_matrix(T[:3, :3]).magnitude())
    return np.linalg.norm(T[:3, 3]) >= KEYFRAME_DISTANCE or angle >= KEYFRAME_ANGLE


# ------------------------------------------------------------------------------------------------
# 7  Evaluation: section 5

BASELINES = "standing still", "mean training motion"
LEGEND = """*: trained on, at least in part. E_t, E_r: KITTI's segments of 100 to 800 m, rectified
left camera frame. t step, r step: mean translation and rotation of inv(T_est) @ T_true per step,
Velodyne frame. -: no such segment, or no ground truth."""


def record_of_file(scan_file, config):
    """A tuple (path, intensity_max) -> the record of that scan. An error names the file."""
    path, intensity_max = scan_file
    scan = kitti.read_scan(path, intensity_max)
    try:
        record, = scan_records(scan, config)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    record["crc"] = zlib.crc32(scan)
    return record


def load_records(sequences, config, cache="cache"):
    """The records (n,) of every sequence, a list: computed, or read from the folder `cache`.

    Prints the notes of each `Sequence` and its number of invalid points on stderr. Raises
    ValueError, naming the file, for a scan that `scan_records` rejects.
    """
    compute = functools.partial(record_of_file, config=config)
    settings = (__version__, config.sa1.r, config.sa2.r, config.sa3.r, config.plane,
                config.max_range)  # n_fps and n_n determine the dtype
    loaded = kitti.cached_records(sequences, compute, record_dtype(config), settings, cache)
    for s, records in zip(sequences, loaded):
        for note in s.notes:
            print(f"sequence {s.name}: {note}", file=sys.stderr)
        if (invalid := records["invalid"]).any():
            print(f"sequence {s.name}: dropped {invalid.sum()} {INVALID_POINTS} in "
                  f"{np.count_nonzero(invalid)} of {len(s)} scans", file=sys.stderr)
    return loaded


def predict_poses(odometry, s, records):
    """Poses T_0t (n,4,4) of a sequence, whose records (n,) are known. Warns about domain shift."""
    shifts = [kitti.domain_shift(stats, odometry.facts["seen"]) for stats in records["stats"]]
    if any(shifts):
        unlike = [shift for shift in shifts if shift]
        print(f"sequence {s.name}: {len(unlike)} of {len(s)} {SHIFT_WARNING}: {unlike[0]}",
              file=sys.stderr)
    if not odometry.refine:  # many pairs at a time are faster than one by one
        return accumulate(predict_motions(odometry.net, records, odometry.device))
    odometry.restart()
    poses = []
    for i in progress(range(len(s)), len(s), f"registering {s.name}, scans"):
        samplings = scan_records(s.scan(i), odometry.net.config, odometry.refine)
        poses.append(odometry.register_records(samplings))
    return np.stack(poses)


def sequence_errors(s, poses, mean_motion):
    """Estimated poses (n,4,4) -> {predictor: (segment errors (segments,), step errors (n-1,2))}.

    The poses are in the Velodyne frame, and so are the step errors. The segment errors are in the
    camera frame, as in KITTI. mean_motion (6,): see `to_vector`. The predictors are "network" and
    the BASELINES. Returns {} without ground truth.
    """
    if s.poses is None:
        return {}
    still, mean = np.eye(4), from_vector(mean_motion)
    paths = [accumulate(np.tile(T, (len(s) - 1, 1, 1))) for T in (still, mean)]
    return {predictor: (metrics.segment_errors(s.poses_cam, kitti.velo_to_camera(T, s.Tr)),
                        metrics.step_errors(s.poses, T))
            for predictor, T in zip(("network", *BASELINES), (poses, *paths))}


def summarize(errors, trained_on):
    """Average the errors -> the dict of results.json: sequences, splits, pooled, lengths.

    errors: {sequence: result of `sequence_errors`}; trained_on: {sequence: bool}.
    """
    def mean(names, predictor="network"):
        pairs = [errors[name][predictor] for name in names if errors[name]]
        summary = metrics.summary([e for e, _ in pairs], [e for _, e in pairs])
        return summary | {"trained_on": any(trained_on[name] for name in names)}

    def pooled(names):
        return mean(names) | {predictor: mean(names, predictor) for predictor in BASELINES}

    splits = {split: [n for n in names if n in errors] for split, names in SPLITS.items()}
    return {"sequences": {name: mean([name]) for name in errors},
            "splits": {split: pooled(names) for split, names in splits.items() if names},
            "pooled": pooled(list(errors)),
            "lengths": metrics.by_length([e["network"][0] for e in errors.values() if e])}


def results_table(results):
    """Format the result of `summarize` as a table, followed by a legend of units and frames."""
    def row(name, s):
        return f"{name} *" if s["trained_on"] else name, s

    rows = [row(name, s) for name, s in results["sequences"].items()]
    for name, s in [*results["splits"].items(), ("all", results["pooled"])]:
        rows.append(row(name, s))
        rows += [(f"  {predictor}", s[predictor]) for predictor in BASELINES]
    rows += results["lengths"].items()
    return f"{metrics.table(rows)}\n{LEGEND}"


def evaluate(data=None, weights=None, sequences=None, out=None, device="cpu", refine=0, plot=False,
             say=print, network=D3DLO):
    """Run the command `eval`: write trajectories and results.json, and print a table of errors.

    data: a folder in KITTI's layout, or a plain folder of scans, which gives a trajectory only.
        None: the simulated city.
    sequences: a list of names or splits. None: all, or the simulated test and validation splits.
    out: a new or empty folder to write to. None: a new one, results/TIME.
    plot: also draw OUT/plot.png.
    say: called with the text to print.
    weights, device, refine, network: see `Odometry`.

    Returns the folder `out`. Raises ValueError if an argument, the weights or the data are
    invalid, and OSError if a file cannot be read or written.
    """
    odometry = Odometry(weights, device, refine, network)
    if plot:
        metrics.new_figure(1, 1)  # without matplotlib, fail now and not after the work
    check_output(out, "results", data or SIMULATED)
    sequences = sequences or ("all" if data else ("test", "validation"))
    root = data_root(data, sequences)
    chosen = kitti.open_sequences(root, sequences)
    loaded = load_records(chosen, odometry.net.config)
    source = {"weights": str(weights or PRETRAINED), "data": str(root), "refine": int(refine)}
    out = claim_output(out, "results", "results.json", source)

    errors, trained_on, trajectories = {}, {}, {}
    for s, records in progress(zip(chosen, loaded), len(chosen), "registering, sequences"):
        poses = predict_poses(odometry, s, records)
        if s.Tr is None:  # a plain folder
            metrics.write_poses(out / "poses.txt", poses)
            kitti.write_tum(out / "poses.tum", poses, s.times)
            results = {"path_m": metrics.path_lengths(poses)[-1], "scans": len(s)}
            lines = [f"{s.folder}: {len(s)} scans, path of {results['path_m']:.1f} m",
                     "frame         LiDAR at the first scan: x forward, y left, z up, in metres",
                     f"trajectory    {out}/poses.txt (12 numbers a line, as in KITTI's pose files)",
                     f"              {out}/poses.tum (t x y z qx qy qz qw, t in seconds)"]
        else:
            errors[s.name] = sequence_errors(s, poses, odometry.facts["mean_motion"])
            # Sequences are compared by content, since different data may have the same name
            trained_on[s.name] = s.fingerprint(records["crc"]) in odometry.facts["trained_on"]
            poses = kitti.velo_to_camera(poses, s.Tr)
            metrics.write_poses(out / f"{s.name}.txt", poses)
        trajectories[s.name] = s.poses_cam, poses
    if errors:
        results = summarize(errors, trained_on)
        lines = [results_table(results),
                 f"trajectories  {out}/NN.txt (KITTI pose files, rectified left camera frame)",
                 f"errors        {out}/results.json"]
    metrics.write_json(out / "results.json", source | results)
    if plot:
        metrics.draw(out / "plot.png", trajectories)
        lines.append(f"plot          {out}/plot.png (from above, errors by length)")
    say("\n".join(lines))
    return out


# ------------------------------------------------------------------------------------------------
# 8  The commands train and eval

SIMULATED = Path("data/simulated")  # the simulated city, used without --data


def check_device(device):
    """Raise ValueError if this PyTorch cannot use the device."""
    try:
        torch.empty(1, device=device).cpu()
    except (RuntimeError, AssertionError, NotImplementedError):
        raise ValueError(f"device {device}: this PyTorch cannot use it; use cpu, or install a "
                         "PyTorch for it") from None


def check_output(out, kind, root):
    """Raise ValueError unless results can go to `out`, a new or empty folder that is not in
    ROOT/sequences or ROOT/poses.

    out: None for a new folder in the folder `kind`; root: the folder of the data. Links are
    resolved.
    """
    if out and os.path.lexists(out) and (not Path(out).is_dir() or any(Path(out).iterdir())):
        raise ValueError(f"--out {out}: exists and is not an empty folder; choose a new one")
    place = Path(out or kind).resolve()
    if any(place.is_relative_to((Path(root) / name).resolve()) for name in ("sequences", "poses")):
        raise ValueError(f"{place} is inside the data folder; choose another folder with --out")


def claim_output(out, kind, name, content):
    """Make the folder `out`, or a new one KIND/TIME if it is None, and write `name` in it as JSON.

    The file must not exist yet, so two processes never share a folder. Returns the folder.
    """
    text = json.dumps(content, indent=1)
    folder = first = Path(out or time.strftime(f"{kind}/%Y-%m-%d-%H%M%S"))
    for i in itertools.count(2):
        folder.mkdir(parents=True, exist_ok=True)
        try:
            with metrics.naming(folder / name), open(folder / name, "x") as file:
                file.write(text + "\n")
            return folder
        except FileExistsError:
            if out:
                raise ValueError(f"--out {out}: another process has just begun to use it; choose "
                                 "a new folder") from None
            folder = first.with_name(f"{first.name}-{i}")


def data_root(data, names):
    """The folder `data` or, if it is None, that of the simulated city, with the sequences `names`.

    Missing ones are simulated. Raises ValueError for a name that the city does not have.
    """
    if data:
        return Path(data)
    names = kitti.expand_splits(names)
    if unknown := set(names) - set(kitti.expand_splits("all")):
        raise ValueError(f"the simulated city has no sequence {' '.join(sorted(unknown))}; "
                         f"available: 00 to 10, {', '.join(SPLITS)}, all")
    return kitti.simulate(SIMULATED, sequences=names)


def choose_sequences(root, names=None):
    """Open the sequences to train on, and the others of the test and validation splits. Two lists.

    names: sequences or splits to train on. None for the training split or, if `root` has nothing of
    it, for all sequences outside the test and validation splits. Raises ValueError if there is
    nothing to train on.
    """
    available = kitti.sequence_names(root)
    held_out = [n for n in SPLITS["test"] + SPLITS["validation"] if n in available]
    names = (names or [n for n in SPLITS["train"] if n in available]
             or [n for n in available if n not in held_out])
    if not names:
        raise ValueError(f"{root}: holds only test and validation sequences, "
                         f"{' '.join(available)}; choose those to train on with --sequences")
    chosen = kitti.open_sequences(root, names)
    names = [s.name for s in chosen]
    return chosen, kitti.open_sequences(root, [n for n in held_out if n not in names])


def training_facts(fingerprints, motions, records, earlier):
    """What a weights file stores about its training data, a dict.

    fingerprints, motions, records: of each sequence. earlier: these facts in the weights that
    training starts from, or {}. Returns trained_on: the fingerprints; mean_motion (6,): that of the
    new data, see `to_vector`; seen (2,4): smallest and largest kitti.STATS of a scan.
    """
    stats = np.vstack([*(r["stats"] for r in records), *earlier.get("seen", ())])
    return {"trained_on": sorted({*fingerprints, *earlier.get("trained_on", ())}),
            "mean_motion": to_vector(np.concatenate(motions)).mean(0).tolist(),
            "seen": [stats.min(0).tolist(), stats.max(0).tolist()]}


def read_run(run):
    """Read RUN/config.json: Config, data, sequences, seed, device and weights of the run."""
    try:
        content = json.loads((run / "config.json").read_text(encoding="utf-8"))
        config, arguments = Config(**content["config"]), content["arguments"]
        require("seed", [arguments["seed"]], 0, 2**63 - 1)
        texts = [*arguments["sequences"], arguments["device"], arguments["data"] or "",
                 arguments["weights"] or ""]
        if not all(isinstance(text, str) for text in texts):
            raise ValueError("damaged")
        names = "data", "sequences", "seed", "device", "weights"
        return config, *(arguments[name] for name in names)
    except (ValueError, KeyError, TypeError, AttributeError, OSError):
        raise ValueError(f"{run}/config.json: missing or damaged, so there is no training run to "
                         "resume; give its folder with --out") from None


def train(config=None, data=None, sequences=None, out=None, seed=0, device=None, resume=False,
          weights=None, network=D3DLO, objective=None):
    """Run the command `train`: train a network, then evaluate it on the held-out sequences.

    config: a Config. None: the paper's settings or, for the simulated city, the short recipe.
    data: a folder in KITTI's layout. None: the simulated city.
    sequences: a list of names or splits to train on. None: see `choose_sequences`.
    out: a new or empty folder for the training run. None: a new one, runs/TIME.
    device: None: that of the run to resume, or the CPU.
    resume: continue the run in `out`. Its config, data, sequences, seed and weights are used again.
    weights: start from these weights and keep their network and input settings.
    network, objective: the class of the network, and the loss; see `load_weights` and `fit`.

    Returns the folder `out`. Raises ValueError if an argument or the data are invalid or the loss
    is not finite, and OSError if a file cannot be read or written.
    """
    if resume:
        run = Path(out or "")
        config, data, sequences, seed, run_device, weights = read_run(run)
        device = device or run_device
    else:
        check_output(out, "runs", data or SIMULATED)
    device = str(device or "cpu")
    check_device(device)
    require("seed", [seed], 0, 2**63 - 1)
    config = config or (Config() if data else Config(**SHORT))
    data, weights = (path and os.path.abspath(path) for path in (data, weights))

    # The network: as in the checkpoint, as in the weights, or with random weights
    torch.manual_seed(seed)
    net, checkpoint, earlier = build(network, config), None, {}
    if resume and (stored := run / "checkpoint.pt").exists():
        with reading_weights(stored, NEW_START):
            checkpoint = earlier = read_archive(stored)
    elif weights:
        net, earlier = load_weights(weights, network)
        # SHORT names every setting of the training, and one of the input, max_range
        settings = {name: getattr(config, name) for name in SHORT if name != "max_range"}
        net.config = replace(net.config, **settings)

    # The data. All scans are read, so that an unusable one is found now and not after the training
    root = data_root(data, [*kitti.expand_splits(sequences or ()), "all"])
    chosen, held_out = choose_sequences(root, sequences)
    motions, names = [s.motions() for s in chosen], [s.name for s in chosen]
    per_epoch = steps_per_epoch(sum(map(len, motions)), net.config)
    loaded = load_records(chosen + held_out, net.config)
    test = [(records, s.motions()) for s, records in zip(held_out, loaded[len(chosen):])
            if s.name in SPLITS["test"] and s.poses is not None and len(s) > 1]
    fingerprints = [s.fingerprint(records["crc"]) for s, records in zip(chosen, loaded)]
    facts = training_facts(fingerprints, motions, loaded[:len(chosen)], earlier)
    if checkpoint and checkpoint.get("trained_on") != facts["trained_on"]:
        raise ValueError(f"{run}: the data has changed since this training run started; resume it "
                         "with the data it was started with")

    if not resume:
        arguments = dict(data=data, sequences=names, seed=int(seed), device=device, weights=weights)
        versions = kitti.versions(Path(__file__).parent) | {"d3dlo": __version__}
        run = claim_output(out, "runs", "config.json", {
            "arguments": arguments, "config": net.config.as_dict(), "versions": versions})

    def say(line):
        """Print a line and append it to the log."""
        log = run / "log.txt"
        with metrics.naming(log), open(log, "a", encoding="utf-8", errors="backslashreplace") as f:
            f.write(line + "\n")
        print(line, flush=True)

    try:
        parameters = sum(p.numel() for p in net.parameters())
        say(f"{parameters:,} parameters, {sum(map(len, motions)):,} pairs of scans of "
            f"{' '.join(names)}, {net.config.epochs} epochs of {per_epoch} batches -> {run}")
        missing = set(SPLITS["train"]) - set(names)
        if not sequences and 0 < len(missing) < len(SPLITS["train"]):
            say(f"missing from the training split: {' '.join(sorted(missing))}")
        fit(net, [*zip(loaded, motions)], run, test, seed, device, objective, checkpoint, say,
            **facts)
        if held_out:
            if resume:
                shutil.rmtree(run / "results", ignore_errors=True)
            evaluate(root, run, [s.name for s in held_out], run / "results", device, say=say,
                     network=network)
    except KeyboardInterrupt:
        advice = f"continue with `python d3dlo.py train --out {run} --resume`"
        raise KeyboardInterrupt(advice) from None
    on_data = f" --data {data}" if data else ""
    say(f"weights       {run}/weights.pt\n"
        f"next          python d3dlo.py eval --weights {run}{on_data}")
    return run


def command_line(argv):
    """Parse the arguments. Returns {option: value} of the options given.

    The defaults of the others are in `Config` and `SHORT`, and in the signatures of `train` and
    `evaluate`.
    """
    settings = dict(formatter_class=argparse.RawDescriptionHelpFormatter,
                    argument_default=argparse.SUPPRESS)
    title, *_, examples = __doc__.split("\n\n")
    parser = argparse.ArgumentParser(prog="d3dlo", description=f"{title}\n\n{examples}", **settings)
    parser.add_argument("--version", action="version", version=f"d3dlo {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="train | eval")
    both = argparse.ArgumentParser(add_help=False, argument_default=argparse.SUPPRESS)
    add = both.add_argument
    add("--data", metavar="ROOT", type=os.path.expanduser, help=(
        "folder in KITTI odometry layout; for eval also a folder of scans (default: a simulated "
        f"city, made in {SIMULATED})"))
    add("--sequences", nargs="+", metavar="NN", help=(
        "names, or splits: train, test, validation, all (default for train: train; for eval: all, "
        "or test and validation of the simulated city)"))
    add("--device", help="cpu, cuda or mps (default: cpu)")
    weights = dict(metavar="FILE|RUN", type=os.path.expanduser)
    out = dict(metavar="DIR", type=os.path.expanduser)

    add = commands.add_parser("train", parents=[both], **settings, help=(
        "train, then evaluate on the test and validation splits")).add_argument
    add("--out", **out, help="new or empty folder for the training run (default: runs/TIME)")
    add("--weights", **weights, help=(
        "start from these weights, a file or the folder of a training run, and keep their network "
        "and input settings"))
    add("--short", action="store_true", help=(
        "our short recipe, the default without --data: few epochs, points within 50 m, Muon, "
        "one-cycle learning rate, augmentation, fixed BatchNorm statistics at the end"))
    for name, kind, what in (("epochs", int, "number of epochs"),
                             ("batch", int, "pairs in a batch"),
                             ("lr", float, "initial learning rate; with --short, the peak")):
        add(f"--{name}", type=kind, metavar="N", help=(
            f"{what} (default: {getattr(Config, name)}; with --short {SHORT[name]})"))
    add("--neighbors", type=int, metavar="N", help=(
        f"neighbours in the first set abstraction, n_n in Table 2 (default: {Config.sa1.n_n})"))
    add("--no-plane", action="store_false", dest="plane", help=(
        "remove the points of the ground plane, Table 2"))
    add("--seed", type=int, metavar="N", help=(
        "random seed for initialisation, order and direction of pairs, and augmentation "
        "(default: 0)"))
    add("--resume", action="store_true", help=(
        "continue the training run in --out with the options it was started with; only --device "
        "may be given, too"))

    add = commands.add_parser("eval", parents=[both], **settings, help=(
        "predict trajectories and print KITTI's errors")).add_argument
    add("--out", **out, help="new or empty folder for the results (default: results/TIME)")
    add("--weights", **weights, help=(
        "a weights file, or the folder of a training run (default: the pretrained weights)"))
    add("--refine", type=int, metavar="N", help=(
        "not in the paper: refine each pose in N passes, each with its own sampling of the scan, "
        "the first against a keyframe, the others against the last scan; 3 is recommended "
        "(default: 0)"))
    add("--plot", action="store_true", help=(
        "draw the paths and the errors by length; needs matplotlib"))
    return vars(parser.parse_args((sys.argv[1:] if argv is None else argv) or ["--help"]))


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
    """Run the command line. Returns the exit code of `metrics.run_command`."""
    args = command_line(argv)
    command = args.pop("command")
    kitti.keep_freed_memory()
    kitti.treat_sigterm_as_interrupt()

    def work():
        if empty := [name for name, value in args.items() if value == ""]:
            raise ValueError(f"--{empty[0]} is empty; give a value, or leave the option out")
        if command == "eval":
            evaluate(**args)
        elif "resume" in args and args.keys() - {"resume", "out", "device"}:
            raise ValueError("--resume continues with the options the run was started with; give "
                             "only --out RUN and, if needed, --device")
        else:
            train(config_from(args), **args)

    if "device" not in args and torch.cuda.is_available():
        print("d3dlo: there is a GPU; --device cuda uses it (nobody has tested it)",
              file=sys.stderr)
    if command == "train":
        advice = ("run it again or, if it has named its folder RUN, continue with "
                  "`python d3dlo.py train --out RUN --resume`")
    else:
        advice = "run it again, with a new --out" if "out" in args else "run it again"
    return metrics.run_command("d3dlo", work, advice)


if __name__ == "__main__":
    sys.exit(main())
