"""D3DLO: Deep 3D LiDAR Odometry (Adis, Horst, Wien; ICIP 2021)

Two LiDAR scans in, the motion between them out: set abstraction on each scan, a flow embedding between them, two more set
abstractions, a mini-PointNet, an MLP; 61,290 parameters. Sampling and grouping depend on no weight, so they are NumPy: those
of a scan are computed once and cached, only the neighbours between two scans are found for each pair. What is learned is torch.
The file follows the paper, but sampling and grouping (3.3.2, 3.3.3) come before the layers that use them. The vector of section 3.2
and the plane of section 4 are in kitti.py, section 5's E_t and E_r in metrics.py.

Frame: Velodyne, x forward, y left, z up, metres. `T_ab` maps points of frame b into frame a. A motion is T_{t,t+1} (eq. 1), as
a vector [tx, ty, tz] in metres and [roll, pitch, yaw] in degrees. Shapes: N points of a scan, S centroids, k neighbours of each,
B pairs of scans, C clouds (scans) in a batch, D features.

    python d3dlo.py train                       # simulated city, 10 minutes on two CPU cores
    python d3dlo.py train --data ROOT           # KITTI odometry, the paper's schedule
    python d3dlo.py eval --data ROOT            # with the weights beside this file
"""
import argparse, copy, ctypes, hashlib, itertools, json, math, platform, shutil, signal, subprocess
import sys, threading, time, warnings, zipfile, zlib
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy
import torch
import torch.nn.functional as F
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch import nn

import kitti
import metrics
from kitti import SPLITS, from_vector, invert, progress, to_vector

WEIGHTS = Path(__file__).with_name("d3dlo.pt")      # the weights shipped
SIMULATED = Path("data/simulated")                  # made under the current folder when no --data is given
STORE_EVERY = 300.0                                 # s, from one checkpoint of a training to the next


# ---------------------------------------------------------------------------------------------------- Table 1 and the choices

class Layer(NamedTuple):
    """A row of Table 1."""
    r: float | None         # radius of the ball [m]
    n_fps: int | None       # centroids kept by farthest point sampling
    n_n: int | None         # neighbours of a centroid
    mlp: tuple              # output width of every linear layer: sa1's [4, 8, 16, 32] are four layers after 4 inputs, else not 61,290


@dataclass(frozen=True)
class Config:
    """Table 1, and the choices the paper leaves open. By default the paper's 500 epochs on KITTI; what is ours says so."""
    #                   r    n_fps  n_n   MLP
    sa1: Layer = Layer(1.0,  1024,    8, (4, 8, 16, 32))
    fe: Layer = Layer(None,  None,   16, (32, 64))
    sa2: Layer = Layer(4.0,   256,   32, (64, 64))
    sa3: Layer = Layer(8.0,    64,    8, (64, 64))
    mpn: Layer = Layer(None, None, None, (64, 256))
    mlp: Layer = Layer(None, None, None, (64, 6))

    spread: int = 1             # ours: which n_n points of a ball: the nearest; with 2 about every second of the nearest 2 n_n, and so on
    max_range: float = 50.0     # m; ours: what is further is left out. Over 80 m, 1,024 centroids lie too far apart for Table 1's balls
    plane: bool = True          # keep the points of the ground plane, Table 2's "pp"
    epochs: int = 500           # section 4
    batch: int = 16             # pairs; ours
    optimizer: str = "adam"     # section 4; "muon" (ours): torch's Muon for the matrices of the hidden layers, Adam for the rest
    lr: float = 1e-3            # Adam's default; the peak of the one-cycle schedule
    schedule: str = "steps"     # x0.1 (ours) at 3/5 and 4/5 of the epochs, 300 and 400 of 500; "one-cycle": torch's OneCycleLR
    swap: str = "both"          # ours: "both" directions of every pair in a batch; "random": one of them, as in section 4; "off": forward
    augment: bool = False       # ours: mirror pairs and move Q by small random motions
    frozen: float = 0.0         # ours: the last share of the steps, trained with BatchNorm's statistics fixed
    coordinates: bool = False   # ours, and DeepCLR's: the mini-PointNet sees where its 64 points are. 61,482 parameters

    # what the paper tried and left; with a 7 in place of mlp's 6 the rotation is a quaternion (section 3.2)
    cosine: float = 0.0         # weight of the cosine distance, eq. 5, in the loss
    cosine_of: str = "motion"   # or "translation", that alone
    uncertainty: bool = False   # section 3.2: homoscedastic uncertainty weighs translation and rotation
    scales: tuple = ()          # section 3.3.2, multi-scale grouping: further Layers for SA1, on the same centroids (their n_fps is ignored)

    def __post_init__(self):
        def layer(r, n_fps, n_n, mlp):                          # json turns tuples into lists; turn them back
            return Layer(r, n_fps, n_n, tuple(mlp))
        for name in ("sa1", "fe", "sa2", "sa3", "mpn", "mlp"):
            object.__setattr__(self, name, layer(*getattr(self, name)))
        object.__setattr__(self, "scales", tuple(layer(*scale) for scale in self.scales))
        grouping = (self.sa1, *self.scales, self.fe, self.sa2, self.sa3)
        if any(len(layer.mlp) < 2 for layer in (*grouping, self.mpn)):
            raise ValueError("Config: every MLP needs at least 2 layers")
        if not 65536 > self.sa1.n_fps >= self.sa2.n_fps >= self.sa3.n_fps > 0:
            raise ValueError("Config: n_fps of sa1, sa2, sa3 must not grow, and stay below 65,536")
        if min(self.epochs, self.batch, self.spread, *(layer.n_n for layer in grouping)) < 1:
            raise ValueError("Config: epochs, batch, spread and every n_n must be 1 or more")
        if not (0 < self.lr < math.inf and 0 < self.max_range < math.inf):
            raise ValueError("Config: lr and max_range must be above 0")
        if not 0 <= self.frozen < 1:
            raise ValueError("Config: frozen is a share, from 0 to below 1")
        if len(self.mlp.mlp) != 2 or self.mlp.mlp[1] not in (6, 7):
            raise ValueError("Config: mlp has two layers, the last of 6 outputs (Euler angles) or 7 (quaternion)")
        for name, choices in (("optimizer", ("adam", "muon")), ("schedule", ("steps", "one-cycle")), ("swap", ("both", "random", "off")),
                              ("cosine_of", ("motion", "translation"))):
            if getattr(self, name) not in choices:
                raise ValueError(f"Config.{name}: {getattr(self, name)!r} is none of {', '.join(choices)}")

    def as_dict(self):
        """Plain lists and numbers, which json and torch.load(weights_only=True) give back; Config(**d) is the inverse."""
        return json.loads(json.dumps(asdict(self)))


SHORT = dict(epochs=9, batch=8, optimizer="muon", lr=1e-2, schedule="one-cycle", augment=True, frozen=0.25)      # 10 minutes on the city


# ------------------------------------------------------------------------------------ sections 3.1, 3.2: problem and objective

def accumulate(motions):
    """Eq. 1: (n-1,4,4) T_{t,t+1} -> (n,4,4) T_{0,t}, the first the identity."""
    return np.stack([*itertools.accumulate(motions, np.matmul, initial=np.eye(4))])


def to_output(T, config):
    """Motions (...,4,4) -> what the network gives for them: (...,6) metres and degrees, or (...,7) metres and a quaternion x y z w."""
    if config.mlp.mlp[1] == 6:
        return to_vector(T)
    return np.concatenate([T[..., :3, 3], Rotation.from_matrix(T[..., :3, :3]).as_quat()], -1)


def from_output(y, config):
    """The inverse of `to_output`."""
    if config.mlp.mlp[1] == 6:
        return from_vector(y)
    T = np.tile(np.eye(4), (*y.shape[:-1], 1, 1))
    T[..., :3, :3], T[..., :3, 3] = Rotation.from_quat(y[..., 3:]).as_matrix(), y[..., :3]
    return T


def loss_unweighted(y_hat, y):
    """Eq. 2: the mean absolute error over metres and degrees alike. (B,6), (B,6) -> ()."""
    return (y - y_hat).abs().mean()


# ----------------------------------------------------------------------- sections 3.3.2, 3.3.3: sampling and grouping (NumPy)

CHUNK = 192     # points in a chunk of neighbours; 128 to 256 are as fast
SPACED = np.array([int(f"{i:b}", 4) for i in range(256)], np.uint16)        # the bits of a byte, moved apart to every second place


def _side_by_side(xyz):
    """(N,3) -> (N,) indices, neighbours near each other: a Z-order curve over azimuth and the logarithm of the range, by which the points
    of a LiDAR are about evenly dense. The order of a tree would serve too, but takes three times as long."""
    x, y = xyz[:, 0], xyz[:, 1]
    with np.errstate(all="ignore"):                         # any order is right, this one is only quick
        azimuth, radius = np.arctan2(y, x), np.log(np.hypot(x, y) + 1)
        a, r = (((c - c.min()) * (255 / max(np.ptp(c), 1e-6))).astype(np.uint8) for c in (azimuth, radius))
    return np.argsort(SPACED[a] | SPACED[r] << 1, kind="stable")


def farthest_point_sampling(xyz: np.ndarray, n: int, start: int = 0) -> np.ndarray:
    """Exact farthest point sampling: (N,3), finite -> (n,) int64 indices. Each pick is the point farthest from all picks before it.

    Ties go to the lowest index (so picks repeat when fewer than n points differ). Nested: the first m picks are what n = m gives.
    The cloud is cut into chunks of neighbours. A pick can shorten distances only in chunks whose bounding box is nearer to it than
    the chunk's largest distance left; all others are skipped. ValueError when there are fewer than n points."""
    xyz = np.asarray(xyz)
    if not (0 < n <= len(xyz) and 0 <= start < len(xyz)):
        raise ValueError(f"farthest point sampling of {n} among {len(xyz)} points from {start}: n must be 1 to {len(xyz)}, start below that")
    xyz = np.asarray(xyz, np.float32 if xyz.dtype == np.float32 else np.float64)
    order = _side_by_side(xyz)
    order = np.pad(order, (0, -len(order) % CHUNK), mode="edge").reshape(-1, CHUNK)            # (chunks,CHUNK), the last one padded
    points = np.ascontiguousarray(xyz[order].transpose(0, 2, 1))                               # (chunks,3,CHUNK)
    low, high = points.min(2).T.copy(), points.max(2).T.copy()                                 # (3,chunks) boxes
    nearest = np.full(order.shape, np.inf, xyz.dtype)       # squared distance of each point to the picks so far
    farthest = nearest[:, 0].copy()                         # the largest of each chunk
    picks = np.empty(n, np.int64)
    picks[0] = start
    for i in range(1, n):                                   # take and reduce have less overhead than [] and sum
        p = xyz[picks[i - 1], :, None]                      # (3,1)
        gap = np.maximum(np.maximum(low - p, p - high), 0)  # (3,chunks) from the pick to the box
        gap *= gap
        chunks = (np.add.reduce(gap, 0) < farthest).nonzero()[0]
        d = points.take(chunks, 0)                          # (k,3,CHUNK), summed in the same order as the gap, so that rounding agrees
        d -= p
        d *= d
        d = np.minimum(np.add.reduce(d, 1), nearest.take(chunks, 0))
        nearest[chunks] = d
        farthest[chunks] = np.maximum.reduce(d, 1)
        chunks = (farthest == np.maximum.reduce(farthest)).nonzero()[0]
        d = nearest.take(chunks, 0)
        picks[i] = order.take(chunks, 0)[d == np.maximum.reduce(d, None)].min()
    return picks


def group_ball(xyz: np.ndarray, centroids: np.ndarray, r: float, n_n: int, tree: cKDTree | None = None, spread: int = 1) -> np.ndarray:
    """The ball of eq. 3: (N,3) points, (S,) indices of the centroids among them -> (S,n_n) indices of points within r metres, r
    included: the nearest n_n, or with spread > 1 n_n in even steps, from first to last, of the nearest spread * n_n.

    The first is the centroid (or a point in the same place). Where there are fewer, the missing slots hold the centroid's own
    index (section 3.3.2, of an empty ball). That changes no maximum, though it counts in BatchNorm's statistics, and it is common: on
    real scans 10 to 18 % of SA1's balls have fewer than 8 points. `tree`, a cKDTree of xyz, saves building one."""
    # ranks as a list: for the number 1 scipy would drop the axis
    _, idx = (tree or cKDTree(xyz)).query(xyz[centroids], [*range(1, spread * n_n + 1)], distance_upper_bound=np.nextafter(r, np.inf))
    size = (idx < len(xyz)).sum(1, keepdims=True)                                              # (S,1); scipy marks a missing one by N
    rank = np.rint(np.arange(n_n) * np.maximum((size - 1) / max(n_n - 1, 1), 1)).astype(int)   # (S,n_n): 0, 1, 2 ... when all fit
    return np.where(rank < size, np.take_along_axis(idx, rank, 1), centroids[:, None])


def group_knn(xyz: np.ndarray, query: np.ndarray, k: int) -> np.ndarray:
    """The neighbours of the flow embedding (section 3.3.3): (N,3) points, (S,3) -> (S,k) indices of the k points nearest to each
    query point; with fewer than k points the nearest is repeated."""
    _, idx = cKDTree(xyz).query(query, [*range(1, k + 1)])
    return np.where(idx == len(xyz), idx[:, :1], idx)


GEOMETRY = 3    # one more when scan_geometry changes, so that older caches are not read
# what tells one kind of scans from another, to say when weights meet a kind they were not trained on
LOOKS = "usable points", "mean intensity", "median range of the centroids [m]", "share of points in the fullest 0.3 m of height, the ground"


def geometry_dtype(config):
    """The record of one scan, all that the network needs of it."""
    n1, (_, n2, k2, _), (_, n3, k3, _) = config.sa1.n_fps, config.sa2, config.sa3
    k1 = sum(scale.n_n for scale in (config.sa1, *config.scales))
    return np.dtype([("xyz", "f4", (n1, 3)),            # centroids of SA1, of which the first n2 and n3 are those of SA2 and SA3
                     ("group", "f4", (n1, k1, 4)),      # their neighbours, scale by scale: offset [m] and intensity
                     ("idx2", "u2", (n2, k2)),          # of SA2's centroids: neighbours among SA1's
                     ("idx3", "u2", (n3, k3)),          # of SA3's: among SA2's
                     ("dropped", "i4"),                 # points left out that no sensor gives: not finite, or of absurd intensity
                     ("looks", "f4", len(LOOKS)),
                     ("crc", "u4")])                    # of all the bytes before


def scan_geometry(scan: np.ndarray, config: Config = Config()) -> np.ndarray:
    """Sampling and grouping of all three set abstractions: scan (N,4) -> record of `geometry_dtype`. FPS is nested, so one
    sampling serves them all. Points that are not finite, beyond config.max_range or of absurd intensity are left out; ValueError when
    too few remain."""
    with np.errstate(over="ignore", invalid="ignore"):
        scan = np.asarray(scan, np.float32)
        if scan.ndim != 2 or scan.shape[1] != 4:
            raise ValueError(f"a scan has the shape (N, 4): x, y, z [m] and intensity, not {scan.shape}")
        x, y, z, intensity = scan.T
        finite = np.isfinite(x + y + z) & (np.abs(intensity) < 65536)       # no sensor gives more; it would end as NaN
        scan = np.ascontiguousarray(scan[finite & (x * x + y * y + z * z < config.max_range ** 2)])
    if not config.plane:
        scan = kitti.remove_plane(scan)
    n1, (r2, n2, k2, _), (r3, n3, k3, _) = config.sa1.n_fps, config.sa2, config.sa3
    if len(scan) < n1:
        usable = f"finite, nearer than {config.max_range:.0f} m, intensity below 65,536" + ("" if config.plane else ", off the ground")
        raise ValueError(f"{len(scan)} usable points ({usable}), at least {n1} are needed; are the coordinates in metres?")
    cloud = np.ascontiguousarray(scan[:, :3])
    with ThreadPoolExecutor(1) as aside:
        tree = aside.submit(cKDTree, cloud, leafsize=48, balanced_tree=False, compact_nodes=False)     # quicker to build, as good to ask
        centroids = farthest_point_sampling(cloud, n1)
    out = np.empty((), geometry_dtype(config))
    out["xyz"] = xyz = cloud[centroids]                                                        # (n1,3)
    balls = [group_ball(cloud, centroids, scale.r, scale.n_n, tree.result(), config.spread) for scale in (config.sa1, *config.scales)]
    out["group"] = scan[np.concatenate(balls, 1)]                                              # (n1,k1,4)
    out["group"][..., :3] -= xyz[:, None]
    out["idx2"] = group_ball(xyz, np.arange(n2), r2, k2, spread=config.spread)
    out["idx3"] = group_ball(xyz[:n2], np.arange(n3), r3, k3, spread=config.spread)
    out["dropped"] = (~finite).sum()
    layer = np.floor(cloud[:, 2] / 0.3).astype(int)
    ground = np.bincount(layer - layer.min()).max() / len(scan)
    out["looks"] = len(scan), scan[:, 3].mean(dtype=float), np.median(np.linalg.norm(xyz, axis=1)), ground
    out["crc"] = zlib.crc32(out.tobytes()[:-4])
    return out


def unlike(looks, seen):
    """(4,) LOOKS of a scan, (2,4) their least and most in training -> what is beyond these by more than a factor of 1.5, in words."""
    return "; ".join(f"{name} {x:.3g} (in training {low:.3g} to {high:.3g})" for name, x, low, high in zip(LOOKS, looks, *seen)
                     if not low / 1.5 <= x <= high * 1.5)


def fingerprint(sequence):
    """16 hex digits that tell a sequence's data from others', wherever they lie: sizes of all scans, first and last scan, poses."""
    digest = hashlib.sha256(np.array([path.stat().st_size for path in sequence.scan_paths]).tobytes())
    for path in (sequence.scan_paths[0], sequence.scan_paths[-1]):
        digest.update(path.read_bytes())
    digest.update(b"" if sequence.poses_cam is None else sequence.poses_cam.tobytes())
    return digest.hexdigest()[:16]


def _geometry_of_file(path, config, intensity_max=1):
    scan = kitti.read_scan(path, intensity_max)
    try:
        return scan_geometry(scan, config)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _cached(file, dtype, n):
    """The records of a cache file, memory-mapped and checked, or None when it is not there or damaged."""
    if not file.is_file():
        return None
    try:
        records = np.load(file, mmap_mode="r")          # runs no code: pickles are off
        rows = records.view(np.uint8).reshape(n, -1)
        if records.dtype == dtype and all(zlib.crc32(row[:-4]) == crc for row, crc in zip(rows, records["crc"])):
            return records
    except Exception:                                   # NumPy raises many kinds; here they are one
        pass
    print(f"{file}: damaged, it is made again", file=sys.stderr)
    return None


def load_geometry(sequences, config, cache="cache"):
    """List of `Sequence` -> list of (n,) arrays of records, memory-mapped from files that are made where there are none yet.

    A file's name is a digest of the data and settings it depends on, so a stale one is never read, and it is moved into place
    when complete, so two runs may share a cache. Scans are shared out over the cores. ValueError for a scan with too few points."""
    dtype = geometry_dtype(config)
    files = []
    for s in sequences:
        depends = (GEOMETRY, fingerprint(s), [p.stat().st_mtime_ns for p in s.scan_paths], dtype.descr, config.sa1.r, config.sa2.r,
                   config.sa3.r, [(scale.r, scale.n_n) for scale in config.scales], config.spread, config.plane, config.max_range, s.intensity_max)
        files.append(Path(cache) / f"{s.name}-{hashlib.sha256(repr(depends).encode()).hexdigest()[:16]}.npy")
    geometry = [_cached(file, dtype, len(s)) for s, file in zip(sequences, files)]
    missing = [(s, file) for s, file, records in zip(sequences, files, geometry) if records is None]
    if missing:
        paths = [path for s, _ in missing for path in s.scan_paths]
        largest = [s.intensity_max for s, _ in missing for _ in s.scan_paths]
        pool = ProcessPoolExecutor(kitti.cores(), initializer=kitti.worker_starts)
        try:
            settings = itertools.repeat(config), largest
            records = pool.map(_geometry_of_file, paths, *settings, chunksize=4)
            records = progress(records, len(paths), "sampling and grouping, scans")
            for s, file in missing:
                shape = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": (len(s),)}
                with metrics.replacing(file) as temporary, open(temporary, "wb") as out:       # a full disk would end a memory map's process
                    np.lib.format.write_array_header_1_0(out, shape)
                    for _ in range(len(s)):
                        out.write(next(records).tobytes())
            next(records, None)                         # lets the progress line end
        finally:
            pool.shutdown(cancel_futures=True)
    geometry = [np.load(file, mmap_mode="r") if records is None else records for file, records in zip(files, geometry)]
    for s, records in zip(sequences, geometry):
        if records["dropped"].any():
            print(f"sequence {s.name}: left out {records['dropped'].sum()} broken points (not finite, or intensity beyond 65,536) in "
                  f"{np.count_nonzero(records['dropped'])} of {len(s)} scans", file=sys.stderr)
    return geometry


class Batch(NamedTuple):
    """C clouds and B pairs (p, q) of them, as tensors."""
    xyz: torch.Tensor       # (C,n1,3)
    group: torch.Tensor     # (C,n1,k1,4)
    idx2: torch.Tensor      # (C,n2,k2)
    idx3: torch.Tensor      # (C,n3,k3)
    p: torch.Tensor         # (B,) the cloud that is P
    q: torch.Tensor         # (B,) the cloud that is Q
    idx_fe: torch.Tensor    # (B,n1,k) neighbours in Q of each centroid of P


def make_batch(clouds, p, q, config, device="cpu"):
    """(C,) records, (B,) and (B,) indices of them -> Batch on `device`. The one thing computed here is what depends on a pair."""
    idx_fe = np.stack([group_knn(clouds["xyz"][j], clouds["xyz"][i], config.fe.n_n) for i, j in zip(p, q)])
    idx2, idx3 = clouds["idx2"].astype(np.int64), clouds["idx3"].astype(np.int64)
    arrays = Batch(clouds["xyz"], clouds["group"], idx2, idx3, p, q, idx_fe)
    return Batch(*(torch.from_numpy(np.ascontiguousarray(array)).to(device) for array in arrays))


# --------------------------------------------------------------------------------------------- section 3.3: the network (torch)

class GatherAdd(torch.autograd.Function):
    """u (B,n,D), v (B,S,D), idx (B,S,k) -> u[b, idx] + v[:, :, None] (B,S,k,D), with its backward pass written out: on a CPU it takes half
    as long as torch's own of gather, and less than that of indexing."""

    @staticmethod
    def forward(ctx, u, v, idx):
        (B, n, D), k = u.shape, idx.shape[2]
        rows = (idx + n * torch.arange(B, device=idx.device)[:, None, None]).view(-1, 1)       # (B*S*k,1)
        ctx.save_for_backward(rows)
        ctx.n = n
        return u.reshape(B * n, D).gather(0, rows.expand(-1, D)).view(B, -1, k, D).add_(v[:, :, None])

    @staticmethod
    def backward(ctx, grad):
        rows, (B, S, k, D) = ctx.saved_tensors[0], grad.shape
        grad_u = grad.new_zeros(B * ctx.n, D).scatter_add_(0, rows.expand(-1, D), grad.reshape(-1, D))
        return grad_u.view(B, ctx.n, D), grad.sum(2), None


class LinearMax(torch.autograd.Function):
    """h (B,S,k,D), W (D',D) -> max over k of h W^T (B,S,D'), and with `moments` E[h] (D,) and E[h^T h] (D,D) over all B*S*k rows.

    One element of the batch at a time, and again in the backward pass, so that the largest tensors of the network, (B,S,k,D') and its
    gradient, never exist in full: memory traffic is what a CPU waits for. Equal maxima share the gradient, as in torch.amax."""

    @staticmethod
    def forward(ctx, h, W, moments):
        B, S, k, D = h.shape
        out, z = h.new_empty(B, S, len(W)), h.new_empty(S * k, len(W))
        first, second = h.new_zeros(D), h.new_zeros(D, D)
        for b, rows in enumerate(h.reshape(B, S * k, D)):
            torch.mm(rows, W.t(), out=z)
            torch.amax(z.view(S, k, -1), 1, out=out[b])
            if moments:
                first += rows.sum(0)
                second.addmm_(rows.t(), rows)
        ctx.save_for_backward(h, W, out)
        return out, first / (B * S * k), second / (B * S * k)

    @staticmethod
    def backward(ctx, grad, grad_first, grad_second):
        h, W, out = ctx.saved_tensors
        B, S, k, D = h.shape
        grad_h, grad_W, z = torch.empty_like(h), torch.zeros_like(W), h.new_empty(S * k, len(W))
        constant, slope = grad_first / (B * S * k), (grad_second + grad_second.t()) / (B * S * k)
        is_max = z.view(S, k, -1)                       # in z's memory: first 0 and 1, then the gradient
        for b, rows in enumerate(h.reshape(B, S * k, D)):
            torch.mm(rows, W.t(), out=z)
            torch.eq(is_max, out[b][:, None], out=is_max)
            is_max.mul_((grad[b] / is_max.sum(1).clamp_(min=1))[:, None])                 # 0 only where all is NaN
            grad_W.addmm_(z.t(), rows)
            torch.addmm(constant, rows, slope, out=grad_h[b].view(S * k, D)).addmm_(z, W)
        return grad_h, grad_W, None


def norm_relu(norm, z):
    """ReLU(BN(z)) over the last axis of z (B,S,k,D). Seen as (B,D,S,k) it is channels-last, for which torch is fast."""
    return F.relu_(norm(z.permute(0, 3, 1, 2))).permute(0, 2, 3, 1)


def linear_norm_relu_max(linear, norm, h):
    """max over k of ReLU(BN(linear(h))): (B,S,k,D) -> (B,S,D').

    ReLU is increasing and BN increasing or decreasing with the sign of its scale, so the maximum is taken first: of z where that
    is positive, of -z where it is negative. BN's statistics are still those of all neighbours; they follow from h's:
    mean = W E[h] + b, var = diag(W Cov[h] W^T)."""
    sign = torch.where(norm.weight < 0, -1.0, 1.0)
    W, b = sign[:, None] * linear.weight, sign * linear.bias
    z, first, second = LinearMax.apply(h, W, norm.training)                                    # (B,S,D'), (D,), (D,D)
    z = z + b
    if norm.training:
        n = h[..., 0].numel()
        mean, var = W @ first + b, ((W @ (second - first[:, None] * first)) * W).sum(1).clamp(min=0)
        with torch.no_grad():                                                                  # as torch's BatchNorm does it
            norm.num_batches_tracked += 1
            share = norm.momentum or 1 / norm.num_batches_tracked.item()
            norm.running_mean.lerp_(sign * mean, share)
            norm.running_var.lerp_(var * n / (n - 1), share)
    else:
        mean, var = sign * norm.running_mean, norm.running_var
    return F.relu((z - mean) * (norm.weight.abs() * torch.rsqrt(var + norm.eps)) + norm.bias)


class MiniPointNet(nn.Module):
    """Section 3.3.1: an MLP shared by all points, h: R^D -> R^D', then the element-wise maximum over them. Every layer is linear,
    batch normalisation, ReLU. It is the core of SA and FE too, which apply the first linear layer in their own way."""

    def __init__(self, d_in, widths):
        super().__init__()
        self.linears = nn.ModuleList(nn.Linear(a, b) for a, b in zip((d_in, *widths), widths))
        self.norms = nn.ModuleList(nn.BatchNorm2d(b) for b in widths)

    def forward(self, x):
        """(B,S,k,D) -> (B,S,D'), the maximum over k."""
        return self.rest(self.linears[0](x))

    def rest(self, z):
        """All that follows the first linear layer, from its output (B,S,k,D1)."""
        h = norm_relu(self.norms[0], z)
        for linear, norm in zip(self.linears[1:-1], self.norms[1:-1]):
            h = norm_relu(norm, linear(h))
        return linear_norm_relu_max(self.linears[-1], self.norms[-1], h)


class SetAbstraction(nn.Module):
    """Section 3.3.2, eq. 3: f'_j = max_i h_sa(f_i, x_i - x'_j) over the neighbours i of centroid j.

    The first linear layer acts on a concatenation, so it is applied to each point before gathering, W [x_i - x'_j, f_i] + b =
    (W_x x_i + W_f f_i) + (b - W_x x'_j): the same parameters and function at a fraction of the memory traffic. (The order, x before f, is
    ours. SA1's neighbours come gathered from the cache, so of it only `h` is called.)"""

    def __init__(self, d_in, layer):
        super().__init__()
        self.h = MiniPointNet(3 + d_in, layer.mlp)

    def forward(self, xyz, feat, idx):
        """xyz (B,n,3), feat (B,n,D), idx (B,S,k) -> features (B,S,D') of the centroids, which are the first S points."""
        W_x, W_f = self.h.linears[0].weight.split([3, feat.shape[2]], dim=1)
        u = xyz @ W_x.t() + feat @ W_f.t()                                                     # (B,n,D1)
        v = self.h.linears[0].bias - xyz[:, :idx.shape[1]] @ W_x.t()                           # (B,S,D1)
        return self.h.rest(GatherAdd.apply(u, v, idx))


class FlowEmbedding(nn.Module):
    """Section 3.3.3, eq. 4: e_i = max_j h_fe(f_i, g_j, y_j - x_i) over the neighbours j in Q of point i of P: the k nearest, as the
    section ends, not a ball. The first linear layer is split as in SetAbstraction."""

    def __init__(self, d_in, layer):
        super().__init__()
        self.h = MiniPointNet(3 + 2 * d_in, layer.mlp)

    def forward(self, xyz_p, feat_p, xyz_q, feat_q, idx):
        """(B,S,3), (B,S,D), (B,n,3), (B,n,D), (B,S,k) -> flow embeddings (B,S,D')."""
        W_x, W_f, W_g = self.h.linears[0].weight.split([3, feat_p.shape[2], feat_q.shape[2]], dim=1)
        u = xyz_q @ W_x.t() + feat_q @ W_g.t()                                                 # (B,n,D1)
        v = self.h.linears[0].bias + feat_p @ W_f.t() - xyz_p @ W_x.t()                        # (B,S,D1)
        return self.h.rest(GatherAdd.apply(u, v, idx))


class D3DLO(nn.Module):
    """The network of Fig. 1 and Table 1: SA1 on both clouds, FE between them, SA2, SA3, mini-PointNet, MLP."""

    def __init__(self, config: Config = Config()):
        super().__init__()
        self.config = config
        self.sa1 = SetAbstraction(1, config.sa1)                                               # c = 1: intensity
        self.scales = nn.ModuleList(SetAbstraction(1, scale) for scale in config.scales)       # none by default
        self.fe = FlowEmbedding(sum(scale.mlp[-1] for scale in (config.sa1, *config.scales)), config.fe)
        self.sa2 = SetAbstraction(config.fe.mlp[-1], config.sa2)
        self.sa3 = SetAbstraction(config.sa2.mlp[-1], config.sa3)
        self.mpn = MiniPointNet(config.sa3.mlp[-1] + 3 * config.coordinates, config.mpn.mlp)
        hidden, out = config.mlp.mlp
        self.mlp = nn.Sequential(nn.Linear(config.mpn.mlp[-1], hidden), nn.BatchNorm1d(hidden), nn.ReLU(), nn.Linear(hidden, out))

    def forward(self, batch: Batch) -> torch.Tensor:
        """Batch -> (B,6): [tx, ty, tz] m and [roll, pitch, yaw] degrees of T_pq (section 3.2), extrinsic x-y-z (ours). With Config's
        quaternion (B,7), see `from_output`."""
        p, q, (n2, n3) = batch.p, batch.q, (batch.idx2.shape[1], batch.idx3.shape[1])
        groups = batch.group.split([scale.n_n for scale in (self.config.sa1, *self.config.scales)], 2)         # neighbours come gathered
        feat = torch.cat([sa.h(group) for sa, group in zip((self.sa1, *self.scales), groups)], 2)              # (C,1024,32), eq. 3
        feat_p, feat_q = feat.index_select(0, p), feat.index_select(0, q)                      # feat[p] has a slow backward pass
        xyz = batch.xyz[p]                                                                     # (B,1024,3)
        flow = self.fe(xyz, feat_p, batch.xyz[q], feat_q, batch.idx_fe)                        # (B,1024,64)
        flow = self.sa2(xyz, flow, batch.idx2[p])                                              # (B,256,64)
        flow = self.sa3(xyz[:, :n2], flow, batch.idx3[p])                                      # (B,64,64)
        if self.config.coordinates:
            flow = torch.cat([xyz[:, :n3] / 10, flow], 2)                                      # (B,64,67), in tens of metres
        whole = self.mpn(flow[:, None])[:, 0]                                                  # (B,256), the maximum over all 64
        y = self.mlp(whole)                                                                    # (B,6)
        return y if y.shape[1] == 6 else torch.cat([y[:, :3], F.normalize(y[:, 3:])], 1)


# ------------------------------------------------------------- sections 3.4, 3.2: what the paper tried beside eq. 2, off by default

def cosine_distance(y_hat, y):
    """Eq. 5, mean over a batch: (B,D), (B,D) -> (). 1e-6 makes it 1 and not NaN for a motion of zero; it matters for millimetres only."""
    return (1 - (y * y_hat).sum(1) * torch.rsqrt((y.square().sum(1) + 1e-6) * (y_hat.square().sum(1) + 1e-6))).mean()


class Objective(nn.Module):
    """Eq. 2, and what the paper tried beside it; see Config. Learned weights, if any, are parameters of this and not of the network."""

    def __init__(self, config):
        super().__init__()
        self.config = config
        if config.uncertainty:
            self.log_variance = nn.Parameter(torch.zeros(2))                                   # of translation, rotation

    def forward(self, y_hat, y):
        """(B,6), (B,6) -> (); or (B,7), where q and -q are the same rotation."""
        config = self.config
        if y.shape[1] == 7:
            sign = torch.where((y[:, 3:] * y_hat[:, 3:]).sum(1, keepdim=True) < 0, -1.0, 1.0)
            y = torch.cat([y[:, :3], sign * y[:, 3:]], 1)
        if config.uncertainty:
            parts = torch.stack([loss_unweighted(y_hat[:, part], y[:, part]) for part in (slice(3), slice(3, None))])
            loss = (torch.exp(-self.log_variance) * parts + self.log_variance).sum()           # Kendall and Cipolla 2017
        else:
            loss = loss_unweighted(y_hat, y)
        if config.cosine:
            n = 3 if config.cosine_of == "translation" else y.shape[1]
            loss = loss + config.cosine * cosine_distance(y_hat[:, :n], y[:, :n])
        return loss


# --------------------------------------------------------------------------------------------------------- odometry, eq. 1

def checksum(model):
    """Of all tensors of a state_dict."""
    return zlib.crc32(b"".join(tensor.cpu().numpy().tobytes() for tensor in model.values()))


def load_weights(path: str | Path | None = None, device: str = "cpu", checkpoint: bool = False) -> tuple[D3DLO, dict]:
    """Weights file or run folder (None: those beside this file) -> (D3DLO in eval mode, the file's dict).
    The network is rebuilt from the file itself. `checkpoint`: of a training, for going on with it. FileNotFoundError, ValueError."""
    path = Path(path or WEIGHTS)
    path = path / "weights.pt" if path.is_dir() else path
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; give a weights.pt or the folder of a run, as `python d3dlo.py train` makes them")
    try:
        if zipfile.ZipFile(path).testzip():             # torch does not look at the checksums
            raise ValueError("damaged")
        state = torch.load(path, map_location="cpu", weights_only=True)
        net = D3DLO(Config(**state["config"]))
        net.load_state_dict(state["model"])
        state["step"], {*state["train"].values(), *state["before"]}     # all must be there
        if checksum(state["model"]) != state["crc"] or np.shape(state["mean_motion"]) != (6,) or np.shape(state["seen"]) != (2, len(LOOKS)):
            raise ValueError("damaged")
    except Exception as error:      # torch and pickle raise many kinds; to the user they are one
        reason = f"{type(error).__name__}: {error}".splitlines()[-1].strip()
        raise ValueError(f"{path}: no weights of D3DLO ({reason:.120}); give a weights.pt or a run folder") from None
    if checkpoint != ("losses" in state):
        raise ValueError(f"{path}: " + ("holds weights, but no training to go on with" if checkpoint else
                                        "a checkpoint, which is not for use; give the weights.pt beside it"))
    return net.to(device).eval(), state


def moved(clouds, T):
    """(C,) records and T (C,4,4), rigid motions or mirrors -> the records with T applied to each cloud. Distances stay, and so sampling and
    balls; the checksum does not."""
    out, T = clouds.copy(), T.astype(np.float32)
    for name in ("xyz", "group"):
        xyz = clouds[name][..., :3]
        out[name][..., :3] = (xyz.reshape(len(T), -1, 3) @ T[:, :3, :3].transpose(0, 2, 1)).reshape(xyz.shape)
    out["xyz"] += T[:, None, :3, 3]
    return out


def answer(net, clouds, p, q, device):
    """(C,) records, (B,) and (B,) indices of them -> T_pq (B,4,4). ValueError when the network gives no numbers."""
    y = net(make_batch(clouds, p, q, net.config, device)).cpu().numpy()
    if not np.isfinite(y).all():
        raise ValueError("the network's answer is not finite; are the intensities between 0 and 1?")
    return from_output(y, net.config)


@torch.inference_mode()
def predict_motions(net, records, device="cpu", batch=16, refine=0):
    """(n,) records of consecutive scans -> (n-1,4,4) T_{t,t+1}, Velodyne frame, one forward pass a pair.

    Not in the paper: with `refine` = N each pair is answered in both directions and averaged; then, N times, Q is moved by the answer so
    far and the network is asked for what is left."""
    out = []
    for i in range(0, len(records) - 1, batch):
        clouds = records[i:i + batch + 1]
        n = len(clouds) - 1
        p, q, T = np.arange(n), np.arange(n) + n, np.tile(np.eye(4), (n, 1, 1))
        if refine:
            for _ in range(1 + refine):
                pairs = np.concatenate([clouds[:-1], moved(clouds[1:], T)])                    # (2n,): the Ps, and then the Qs
                T_pq, T_qp = np.split(answer(net, pairs, np.r_[p, q], np.r_[q, p], device), 2)
                T = T_pq @ from_vector(to_vector(invert(T_pq) @ invert(T_qp)) / 2) @ T         # half-way between the two, after T
        else:
            T = answer(net, clouds, p, p + 1, device)
        out.append(T)
    return np.concatenate(out) if out else np.empty((0, 4, 4))


class Odometry:
    """Poses from scans, one at a time: `Odometry().register(scan)`. `weights`: a file or a run folder, None for those shipped;
    `refine`: see `predict_motions`."""

    def __init__(self, weights: str | Path | None = None, device: str = "cpu", refine: int = 0):
        self.net, state = load_weights(weights, device)
        self.seen, self.device, self.refine, self.pose, self.last = state["seen"], device, refine, np.eye(4), None

    def register(self, scan: np.ndarray) -> np.ndarray:
        """(N,4) float32 x, y, z [m], intensity 0..1 -> pose (4,4) float64 T_{0,t} of this scan in the first one's Velodyne frame,
        the identity for the first. The motion depends on the last two scans alone. Broken points are left out with a warning;
        ValueError for a scan that is refused, which changes nothing."""
        record = scan_geometry(scan, self.net.config)
        if record["dropped"]:
            warnings.warn(f"left out {record['dropped']} broken points (not finite, or intensity beyond 65,536)", stacklevel=2)
        if self.seen and (strange := unlike(record["looks"], self.seen)):
            warnings.warn(f"a scan unlike those the weights were trained on, do not trust the answer: {strange}", stacklevel=2)
            self.seen = None                            # said once
        if self.last is not None:
            self.pose = self.pose @ predict_motions(self.net, np.stack([self.last, record]), self.device, refine=self.refine)[0]
        self.last = record
        return self.pose.copy()


def relative_pose(scan_p: np.ndarray, scan_q: np.ndarray, weights: str | Path | None = None, refine: int = 0) -> np.ndarray:
    """Two scans (N,4) -> T_pq (4,4) float64, which maps points of Q into P's frame (section 3.1). As in `Odometry`, which serves
    better for many pairs: the weights are loaded at each call."""
    odometry = Odometry(weights, refine=refine)
    odometry.register(scan_p)
    return odometry.register(scan_q)


# --------------------------------------------------------------------------------------------------------- section 4: training

def augment(clouds, T_pq, rng):
    """Cheap variety that changes no sampling and no ball, not in the paper: mirror half of the pairs left and right, and move Q by a
    small random motion A, so that q' = A q and T_pq' = T_pq A^-1; a quarter of the Qs first by T_pq, so that little motion is left, as
    when `predict_motions` refines. (2n,) records, the Ps and then the Qs, (n,4,4) -> the same, changed."""
    n = len(T_pq)
    M = np.where(rng.random((n, 1, 1)) < 0.5, np.diag([1.0, -1, 1, 1]), np.eye(4))
    A = from_vector(rng.normal(size=(n, 6)) * [0.25, 0.1, 0.03, 0.1, 0.1, 1.0])   # m, degrees; most yaw: turns are rare, and learned last
    T_pq = M @ T_pq @ M
    A = A @ np.where(rng.random((n, 1, 1)) < 0.25, T_pq, np.eye(4))
    return moved(clouds, np.concatenate([M, A @ M])), T_pq @ invert(A)


def training_batch(geometry, motions, pairs, config, rng, device="cpu"):
    """Pairs (n,2) of (sequence, scan) -> Batch and targets (B,6), see `to_output`: of (P, Q) T, and of (Q, P) T^-1."""
    clouds = np.stack([geometry[s][i + d] for d in (0, 1) for s, i in pairs])                  # (2n,): all P, all Q
    T_pq = np.stack([motions[s][i] for s, i in pairs])                                         # (n,4,4)
    if config.augment:
        clouds, T_pq = augment(clouds, T_pq, rng)
    p, q, T = np.arange(len(pairs)), np.arange(len(pairs)) + len(pairs), T_pq
    if config.swap == "both":
        p, q, T = np.concatenate([p, q]), np.concatenate([q, p]), np.concatenate([T, invert(T)])
    elif config.swap == "random":                                                              # the paper's coin
        forward = rng.random(len(pairs)) < 0.5
        p, q, T = np.where(forward, p, q), np.where(forward, q, p), np.where(forward[:, None, None], T, invert(T))
    target = torch.from_numpy(to_output(T, config).astype(np.float32)).to(device)
    return make_batch(clouds, p, q, config, device), target


def batches(geometry, motions, config, seed, start, stop, device="cpu"):
    """Yields training batches number `start` to `stop` (excluded), made one ahead in a thread. Each depends on `seed` (a tuple) and
    its number alone, so a training goes on after an interruption as if there had been none."""
    pairs = np.array([(s, i) for s, T in enumerate(motions) for i in range(len(T))])
    per_epoch = steps_per_epoch(motions, config)

    def make(step):
        epoch, part = divmod(step, per_epoch)
        order = np.random.default_rng([*seed, epoch]).permutation(len(pairs))
        chosen = np.array_split(order, per_epoch)[part]     # nearly equal parts: BatchNorm wants no small batch
        rng = np.random.default_rng([*seed, epoch, part + 1])   # + 1: NumPy takes a trailing 0 for nothing
        return training_batch(geometry, motions, pairs[chosen], config, rng, device)

    with ThreadPoolExecutor(1) as pool:
        ahead = pool.submit(make, start)
        for step in range(start, stop):
            batch = ahead.result()
            if step + 1 < stop:
                ahead = pool.submit(make, step + 1)
            yield batch


def steps_per_epoch(motions, config):
    """Batches in which all pairs come once."""
    return math.ceil(sum(map(len, motions)) / config.batch)


def optimizers(net, objective):
    """What minimises the objective: Adam (section 4), and with Config's "muon" also Muon, whose steps are as long as Adam's would be."""
    config, parameters = net.config, [*net.parameters(), *objective.parameters()]
    if config.optimizer == "adam":
        return [torch.optim.Adam(parameters, config.lr)]
    matrices = {p for p in net.parameters() if p.ndim == 2} - {net.mlp[-1].weight}
    return [torch.optim.Adam([p for p in parameters if p not in matrices], config.lr),
            torch.optim.Muon([p for p in parameters if p in matrices], config.lr, weight_decay=0, adjust_lr_fn="match_rms_adamw")]


def schedule(optimizer, config, steps):
    """The learning rate over all steps: the paper's decay at 300 and 400 of 500 epochs, in proportion, or torch's one cycle."""
    if config.schedule == "one-cycle":
        return torch.optim.lr_scheduler.OneCycleLR(optimizer, config.lr, total_steps=steps)
    return torch.optim.lr_scheduler.MultiStepLR(optimizer, [max(1, steps * 3 // 5), max(1, steps * 4 // 5)], gamma=0.1)


@torch.no_grad()
def recompute_statistics(net, examples):
    """BatchNorm's running averages lag behind the weights; replace them by the plain mean over these examples (Batch,
    target), weights fixed."""
    momenta = {m: m.momentum for m in net.modules() if isinstance(m, nn.modules.batchnorm._BatchNorm)}
    for norm in momenta:
        norm.reset_running_stats()
        norm.momentum = None
    net.train()
    for batch, _ in examples:
        net(batch)
    for norm, momentum in momenta.items():
        norm.momentum = momentum


def save(path, model, **state):
    """The state_dict of a network and plain values to a file, through a temporary one."""
    with metrics.replacing(path) as temporary, open(temporary, "wb") as file:       # of a file's name torch would write it into the file
        try:
            torch.save({**state, "model": model, "crc": checksum(model)}, file)
        except RuntimeError as error:                   # torch's word for a full disk
            raise OSError(f"{path}: not written ({str(error).splitlines()[0]:.80})") from None


@contextmanager
def interruption_waits():
    """Ctrl-C and SIGTERM wait for the step under way: yields a list, no longer empty once one came. A second one does not wait."""
    came, before = [], {}

    def note(number, frame):
        if came:
            raise KeyboardInterrupt
        came.append(number)
    if threading.current_thread() is threading.main_thread():                                  # Python's rule for signals
        before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield came
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def parts_of(net, steps, device="cpu"):
    """All that a training of so many steps changes, which is what a checkpoint holds: {name: network, objective, optimisers, schedules}."""
    objective = Objective(net.config).to(device)
    parts = {"model": net, "objective": objective}
    for i, optimizer in enumerate(optimizers(net, objective)):
        parts |= {f"optimizer{i}": optimizer, f"scheduler{i}": schedule(optimizer, net.config, steps)}
    return parts


def training_step(objective, net, batch, target, minimizers):
    """One step of `minimizers`, the optimisers and their schedules, in the mode the network is in. Returns the loss before it."""
    loss = objective(net(batch), target)
    net.zero_grad()
    objective.zero_grad()
    loss.backward()
    for minimizer in minimizers:
        minimizer.step()
    return loss.item()


def fit(net, geometry, motions, run, seed=0, device="cpu", checkpoint=None, say=print, **remember):
    """Train `net` as its config says (section 4). Returns a net for use, in eval mode.

    That needs BatchNorm statistics that fit the weights, so they are recomputed: at the end or, with config.frozen, before that last share of
    the steps, which then train in eval mode: the network as it will be used, without the noise of a batch's statistics.

    Every STORE_EVERY seconds and at the end writes RUN/checkpoint.pt, whose content `checkpoint` goes on from, and RUN/weights.pt, the net for
    use, with `remember` in both. When interrupted finishes its step, writes the checkpoint and raises KeyboardInterrupt."""
    config, per_epoch, run = net.config, steps_per_epoch(motions, net.config), Path(run)
    total = config.epochs * per_epoch
    frozen_from = round(total * (1 - config.frozen))
    parts = parts_of(net, total, device)
    _, objective, *minimizers = parts.values()              # the last are the optimisers and their schedules
    step, losses = 0, []
    if checkpoint:
        step, losses = checkpoint["step"], checkpoint["losses"]
        for name, part in parts.items():
            part.load_state_dict(checkpoint[name])

    def fixed_batches():        # drawn like those of the training, by random numbers of their own
        return batches(geometry, motions, config, (seed, 2 ** 31), 0, min(25, total), device)

    def store_checkpoint():
        save(run / "checkpoint.pt", config=config.as_dict(), step=step, losses=losses, **remember,
             **{name: part.state_dict() for name, part in parts.items()})

    def store_weights():
        usable = copy.deepcopy(net)
        if step <= frozen_from:
            recompute_statistics(usable, fixed_batches())
        save(run / "weights.pt", config=config.as_dict(), step=step, **remember, model=usable.state_dict())
        return usable.eval()

    stored, todo = time.monotonic(), batches(geometry, motions, config, (seed,), step, total, device)
    with interruption_waits() as came:
        for batch, target in progress(todo, total - step, f"training, batches of {config.batch} pairs, swap: {config.swap}"):
            if step == frozen_from:
                recompute_statistics(net, fixed_batches())
            rate = minimizers[0].param_groups[0]["lr"]
            losses.append(training_step(objective, net.train(step < frozen_from), batch, target, minimizers))
            step += 1
            if step % per_epoch == 0:
                say(f"epoch {step // per_epoch}/{config.epochs}: loss {np.mean(losses):.4f}, learning rate {rate:.1e}")
                losses = []
            if came:
                break
            if time.monotonic() - stored > STORE_EVERY:
                store_checkpoint()
                store_weights()
                stored = time.monotonic()
        store_checkpoint()
        if came:
            raise KeyboardInterrupt(f"step {step} is stored; python d3dlo.py train --out {run} --resume goes on from it")
    usable = store_weights()
    with torch.no_grad():
        loss = np.mean([objective(usable(batch), target).item() for batch, target in fixed_batches()])
    say(f"loss in eval mode, as it is used: {loss:.4f}, over some batches of the training")
    return usable


# ------------------------------------------------------------------------------------------------------ section 5: evaluation

BASELINES = "standing still", "mean motion of training"


def warn_of_unlike(s, records, seen):
    """Say on stderr how many scans of a sequence are unlike those in training, `seen`."""
    strange = [words for words in (unlike(looks, seen) for looks in records["looks"]) if words]
    if strange:
        print(f"sequence {s.name}: {len(strange)} of {len(s)} scans are unlike those the weights were trained on, do not trust the answer: "
              f"{strange[0]}", file=sys.stderr)


def run_folder(net, state, s, out, device="cpu", refine=0, plot=False, say=print):
    """Register a `ScanFolder`. Write OUT/poses.txt and OUT/poses.tum in the LiDAR's frame; there is
    no ground truth, so no error either."""
    began = time.monotonic()
    records, = load_geometry([s], net.config)
    warn_of_unlike(s, records, state["seen"])
    poses = accumulate(predict_motions(net, records, device, refine=refine))
    speed = len(s) / (time.monotonic() - began)
    metrics.write_poses(out / "poses.txt", poses)
    metrics.write_tum(out / "poses.tum", poses, s.times)
    say(f"{s.folder}: {len(s)} scans, {metrics.path_lengths(poses)[-1]:.1f} m, "
        f"{speed:.1f} scans a second (faster where scans are cached)")
    for note in s.notes:
        say(f"Note: {note}.")
    say("Poses are in the LiDAR's frame of the first scan: x forward, y left, z up, metres.\n"
        f"trajectory    {out}/poses.txt (KITTI pose file)\n"
        f"              {out}/poses.tum (t x y z qx qy qz qw, t in seconds)")
    if plot:
        metrics.draw(out / "plot.png", {s.name: (None, poses)})
        say(f"picture       {out}/plot.png (from above)")


def run_network(net, state, s, records, out, device="cpu", refine=0):
    """Register a sequence and write OUT/NN.txt, a KITTI pose file -> {predictor: (segment, step errors)}, empty without ground truth."""
    warn_of_unlike(s, records, state["seen"])
    motions, errors = predict_motions(net, records, device, refine=refine), {}
    constant = (np.broadcast_to(T, motions.shape) for T in (np.eye(4), from_vector(state["mean_motion"])))
    for predictor, T in zip(("network", *BASELINES), (motions, *constant)):
        poses = accumulate(T)
        poses_cam = kitti.velo_to_camera(poses, s.Tr)
        if predictor == "network":
            metrics.write_poses(out / f"{s.name}.txt", poses_cam)
        if s.poses is not None:
            errors[predictor] = metrics.segment_errors(s.poses_cam, poses_cam), metrics.step_errors(s.poses, poses)
    return errors


def report(errors, trained_on, out, source):
    """{sequence: what `run_network` gave}, {sequence: whether the weights were trained on its data} -> the table, in which those are
    marked; with `source` written to OUT/results.json."""
    def summary(names, predictor="network"):
        some = [errors[name][predictor] for name in names if errors[name]]
        return metrics.summary([e for e, _ in some], [e for _, e in some]) | {"trained_on": any(trained_on[n] for n in names)}

    each = {name: summary([name]) for name in errors}
    parts = {split: [n for n in names if n in errors] for split, names in SPLITS.items()} | {"all": list(errors)}
    parts = {part: summary(names) | {p: summary(names, p) for p in BASELINES} for part, names in parts.items() if names}
    lengths = metrics.by_length([e["network"][0] for e in errors.values() if e])
    splits = {split: parts[split] for split in SPLITS if split in parts}
    results = {**source, "sequences": each, "splits": splits, "pooled": parts["all"], "lengths": lengths}
    plain = json.loads(json.dumps(results), parse_constant=lambda nan: None)    # JSON has no NaN
    with metrics.replacing(out / "results.json") as temporary:
        temporary.write_text(json.dumps(plain, indent=1) + "\n", encoding="utf-8")

    rows = [metrics.row(name + " *" * s["trained_on"], s) for name, s in each.items()]
    for part, s in parts.items():
        rows += [metrics.row(part + " *" * s["trained_on"], s), *(metrics.row(f"  {p}", s[p]) for p in BASELINES)]
    rows += [metrics.row(length, s) for length, s in lengths.items()]
    return (metrics.table(metrics.HEADER, rows) + "\n*: trained on. E_t, E_r: KITTI's segments of 100 to 800 m, rectified left camera "
            "frame. t step, r step: mean length and\nangle of inv(T_est) @ T_true of a step, Velodyne frame. -: no such segment, or no "
            f"ground truth.\ntrajectories  {out}/NN.txt (KITTI pose files, rectified left camera frame)\nfigures       {out}/results.json")


# ------------------------------------------------------------------------------------------------------------- command line

def data_root(data, names, whole=False):
    """`data`, or if None the simulated city, of which the sequences named, or the `whole`, are made. ValueError for a name unknown."""
    names = [names] if isinstance(names, str) else names or ()
    if data:
        return Path(data)
    if strange := set(names) - {"all", *SPLITS, *sum(SPLITS.values(), ())}:
        raise ValueError(f"the simulated city has no sequence {' '.join(sorted(strange))}: there are 00 to 10, {', '.join(SPLITS)}, and all")
    return kitti.simulate(SIMULATED, sequences="all" if whole else names)


def choose(root, names=None):
    """Lists of `Sequence`: those to train on (names None: the training split, or without any of it all that is in no split), and those of the
    test and validation splits that are there beside them. ValueError when there is nothing to train on."""
    there, held_out = kitti.sequence_names(root), SPLITS["test"] + SPLITS["validation"]
    names = names or [n for n in SPLITS["train"] if n in there] or [n for n in there if n not in held_out]
    if not names:
        raise ValueError(f"{root}: holds only test and validation sequences, {' '.join(there)}; --sequences names those to train on")
    chosen = kitti.open_sequences(root, names)
    if not sum(len(s) - 1 for s in chosen):
        raise ValueError(f"{root}: sequence {' '.join(s.name for s in chosen)} has a single scan; training needs pairs")
    return chosen, kitti.open_sequences(root, [n for n in held_out if n in there and n not in [s.name for s in chosen]])


def remembered(digests, motions, geometry, parent):
    """What a file of weights holds of the data of its training, `parent` being what the weights held that it began from."""
    looks = np.concatenate([*(records["looks"] for records in geometry), np.reshape(parent["seen"], (-1, len(LOOKS)))])
    return {"train": digests, "before": sorted({*parent["before"], *parent["train"].values()}),
            "mean_motion": to_vector(np.concatenate(motions)).mean(0).tolist(), "seen": [looks.min(0).tolist(), looks.max(0).tolist()]}


def train(config=None, data=None, sequences=None, out=None, seed=0, device="cpu", resume=False, weights=None):
    """The command `train`: train on `sequences` of `data` (None: the simulated city) as `config` says (None: the paper's, or the short
    recipe without data), evaluate on what there is of the test and validation splits beside them. With `weights` it begins from those,
    whose network is kept; only the fields named in SHORT are then taken from `config`. Returns the run folder. ValueError, OSError."""
    check_device(device)
    run = Path(out or time.strftime("runs/%Y-%m-%d-%H%M%S"))
    if (run / "config.json").exists() and not resume:
        raise ValueError(f"{run}: holds a training already; add --resume to go on with it, or choose another --out")
    config = config or Config(**({} if data else SHORT))
    if resume:
        config, data, sequences, seed, weights = begun_with(run)
    data, weights = (path and str(Path(path).resolve()) for path in (data, weights))
    stored, parent = run / "checkpoint.pt", {"train": {}, "before": [], "seen": []}
    state = load_weights(stored, device, checkpoint=True)[1] if resume and stored.exists() else None
    if state:
        parent = state | {"train": {}}
    elif weights:
        first, parent = load_weights(weights)
        config = replace(first.config, **{name: getattr(config, name) for name in SHORT})
    root = data_root(data, sequences, whole=True)
    chosen, held_out = choose(root, sequences)
    names, motions, digests = [s.name for s in chosen], [s.motions() for s in chosen], {s.name: fingerprint(s) for s in chosen}
    if state and state["train"] != digests:
        raise ValueError(f"{stored}: was trained on other data than lies there now; resume with the data it was begun with")
    geometry = load_geometry(chosen + held_out, config)[:len(chosen)]           # of all, so that a scan held out that is broken is met now
    remember = remembered(digests, motions, geometry, parent)
    note_beginning(run, dict(data=data, sequences=names, seed=seed, device=device, weights=weights), config, digests)

    def say(line):
        print(line, flush=True)
        with open(run / "log.txt", "a", encoding="utf-8") as log:
            log.write(line + "\n")

    torch.manual_seed(seed)
    net = D3DLO(config).to(device)
    if weights and not state:
        net.load_state_dict(first.state_dict())
    say(f"{sum(p.numel() for p in net.parameters()):,} parameters, {sum(map(len, motions)):,} pairs of scans of {' '.join(names)}, "
        f"{config.epochs} epochs of {steps_per_epoch(motions, config)} batches -> {run}")
    if not sequences and (gone := set(SPLITS["train"]) - set(names)):
        say(f"of the training split {' '.join(sorted(gone))} are not there")
    fit(net, geometry, motions, run, seed, device, state, say, **remember)
    if held_out:
        evaluate(root, run, [s.name for s in held_out], run / "results", device, say=say)
    say(f"weights       {run}/weights.pt\nnext          python d3dlo.py eval --weights {run}" + (f" --data {data}" if data else ""))
    return run


def evaluate(data=None, weights=None, sequences=None, out=None, device="cpu", refine=0, plot=False, say=print):
    """The command `eval`: say the table of `weights` (None: shipped) on `sequences` of `data` (None: the simulated test and
    validation sequences). Returns the folder with trajectories and figures. ValueError, FileNotFoundError."""
    check_device(device)
    net, state = load_weights(weights, device)
    if plot:
        metrics.picture(1, 1)                                   # say so now if it cannot be drawn, not after the work
    out = Path(out or time.strftime("results/%Y-%m-%d-%H%M%S"))
    sequences = sequences or ("all" if data else ("test", "validation"))
    root = data_root(data, sequences)
    chosen = kitti.open_sequences(root, sequences)
    if isinstance(chosen[0], kitti.ScanFolder):
        run_folder(net, state, chosen[0], out, device, refine, plot, say)
        return out
    for s in chosen:
        if s.poses is None and (s.folder / "poses.txt").exists():
            print(f"{s.folder}/poses.txt: SemanticKITTI's, estimated by SuMa; not used, it is no ground truth", file=sys.stderr)
    work = progress(zip(chosen, load_geometry(chosen, net.config)), len(chosen), "registering, sequences")
    errors = {s.name: run_network(net, state, s, records, out, device, refine) for s, records in work}
    seen = {*state["train"].values(), *state["before"]}        # fingerprints: another sequence may have the same name
    trained_on = {s.name: fingerprint(s) in seen for s in chosen}
    say(report(errors, trained_on, out, {"weights": str(weights or WEIGHTS), "data": str(root), "refine": refine}))
    server = [str(i) for i in range(11, 22)]                    # KITTI's sequences without ground truth
    if set(server) <= set(errors):
        with metrics.replacing(out / "kitti-server.zip") as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive:
            for name in server:                                 # in its root, as the devkit's readme wants them
                archive.write(out / f"{name}.txt", f"{name}.txt")
        say(f"to submit     {out}/kitti-server.zip")
    if plot:
        metrics.draw(out / "plot.png", {s.name: (s.poses_cam, metrics.read_poses(out / f"{s.name}.txt")) for s in chosen})
        say(f"picture       {out}/plot.png (from above, errors by length)")
    return out


def check_device(device):
    """ValueError when this PyTorch cannot use the device."""
    try:
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError, NotImplementedError):
        raise ValueError(f"--device {device}: not available here; use cpu, or cuda or mps where PyTorch has them") from None


def keep_freed_memory():
    """Where the C library is glibc, let it keep large freed blocks. It would hand them back to the system and page-fault them in
    again at the next allocation, which is a third of the time of a training step."""
    try:
        libc = ctypes.CDLL(None)
        libc.mallopt(-4, 0)             # M_MMAP_MAX: large blocks from the heap too
        libc.mallopt(-1, 2 ** 31 - 1)   # M_TRIM_THRESHOLD: and the heap never shrinks
    except (OSError, AttributeError, TypeError):
        pass


def note_beginning(run, arguments, config, fingerprints):
    """RUN/config.json: all that is needed to repeat a training, or to go on with it."""
    here = Path(__file__).resolve().parent
    git = shutil.which("git") if (here / ".git").exists() else None            # of another repository, or none, it would not tell
    code = git and subprocess.run([git, "-C", here, "describe", "--always", "--dirty"], capture_output=True, text=True).stdout.strip()
    versions = {"d3dlo": code, "python": platform.python_version(), "numpy": np.__version__, "scipy": scipy.__version__,
                "torch": torch.__version__}
    begun = dict(arguments=arguments, config=config.as_dict(), versions=versions, fingerprints=fingerprints)
    with metrics.replacing(run / "config.json") as temporary:
        temporary.write_text(json.dumps(begun, indent=1) + "\n", encoding="utf-8")


def begun_with(run):
    """Config, data, sequences, seed and weights a training was begun with, from RUN/config.json."""
    try:
        begun = json.loads((run / "config.json").read_text(encoding="utf-8"))
        return Config(**begun["config"]), *(begun["arguments"][name] for name in ("data", "sequences", "seed", "weights"))
    except (ValueError, KeyError, TypeError, OSError):
        raise ValueError(f"{run}/config.json: missing or damaged, so there is no training to go on with; give its folder by --out") from None


def number(text):
    """A whole number, 0 or more, for argparse."""
    if int(text) < 0:
        raise argparse.ArgumentTypeError("must be 0 or more")
    return int(text)


def command_line(argv):
    """Arguments -> {option: value}, only of those that were given: defaults are those of `train`, `evaluate` and `Config`."""
    how = dict(formatter_class=argparse.RawDescriptionHelpFormatter, argument_default=argparse.SUPPRESS)
    paragraphs = __doc__.split("\n\n")
    parser = argparse.ArgumentParser(prog="d3dlo", description=f"{paragraphs[0]}\n\n{paragraphs[-1]}", **how)
    commands = parser.add_subparsers(dest="command", required=True, metavar="train | eval")
    t = commands.add_parser("train", **how, help="train, then evaluate on the test and validation splits", description=(
        "Train D3DLO, then evaluate it on the test and validation splits.\n\n  python d3dlo.py train\n"
        "  python d3dlo.py train --data ROOT\n  python d3dlo.py train --data ROOT --sequences 00 01 --short --epochs 20\n"
        "  python d3dlo.py train --data ROOT --weights d3dlo.pt --short --lr 0.002\n"
        "  python d3dlo.py train --out RUN --resume"))
    e = commands.add_parser("eval", **how, help="trajectories and KITTI's errors", description=(
        "Run D3DLO over sequences, write their trajectories, print KITTI's errors.\n"
        "A plain folder of scans (*.bin or *.npy) gives a trajectory only.\n\n"
        "  python d3dlo.py eval\n  python d3dlo.py eval --data FOLDER --plot\n"
        "  python d3dlo.py eval --data ROOT --sequences test\n  python d3dlo.py eval --data ROOT --weights RUN --sequences 11 12"))
    for command in (t, e):
        add = command.add_argument_group("data").add_argument
        layouts = "folder in KITTI odometry layout" + (", or of scans" if command is e else "")
        add("--data", metavar="ROOT",
            help=f"{layouts} (default: a simulated city, made in {SIMULATED})")
        add("--sequences", nargs="+", metavar="NN", help="names, or splits: train, test, validation, all")

    add = t.add_argument_group("network").add_argument
    add("--weights", metavar="FILE|RUN", help="start from these weights and their network, not from random ones")
    add("--neighbors", type=int, metavar="N", help=f"n_n of the first set abstraction, Table 2 (default: {Config.sa1.n_n})")
    add("--no-plane", action="store_false", dest="plane", help="leave out the points of the ground plane, Table 2")
    add = t.add_argument_group("training").add_argument
    add("--short", action="store_true", help=(
        "our short recipe: few epochs, one-cycle rate, Muon, augmentation, BatchNorm fixed at the end (implied without --data)"))
    add("--epochs", type=int, metavar="N", help=f"default: {Config.epochs}, short {SHORT['epochs']}")
    add("--batch", type=int, metavar="N", help=f"pairs in a batch, each both ways (default: {Config.batch}, short {SHORT['batch']})")
    add("--lr", type=float, metavar="X", help=f"learning rate, at its highest (default: {Config.lr}, short {SHORT['lr']})")
    add("--seed", type=number, metavar="N", help="of the first weights, the order of pairs and the augmentation (default: 0)")
    add("--device", help="cpu, cuda or mps (default: cpu)")
    add = t.add_argument_group("run").add_argument
    add("--out", metavar="RUN", help="folder of the run (default: runs/TIME)")
    add("--resume", action="store_true", help="go on with the training in --out, with the options it was begun with")

    add = e.add_argument_group("network").add_argument
    add("--weights", metavar="FILE|RUN", help="weights, or folder of a run (default: those shipped)")
    add("--refine", type=number, metavar="N", help=(
        "not in the paper: average both directions, and apply the network N more times to what is left (default: 0, the plain answer)"))
    add("--device", help="cpu, cuda or mps (default: cpu)")
    add = e.add_argument_group("results").add_argument
    add("--out", metavar="DIR", help="folder for NN.txt and results.json (default: results/TIME)")
    add("--plot", action="store_true", help="draw the paths and the errors by length; needs matplotlib")
    return vars(parser.parse_args(argv))


def config_from(args):
    """The Config that `train` was asked for; its options are taken out of args, the rest is what the function takes."""
    if "weights" in args and args.keys() & {"neighbors", "plane"}:
        raise ValueError("--weights brings its network along; leave out --neighbors and --no-plane")
    recipe = SHORT if args.pop("short", not args.get("data")) else {}
    given = {name: args.pop(name) for name in ("epochs", "batch", "lr", "plane") if name in args}
    return Config(**recipe | given, sa1=Config.sa1._replace(n_n=args.pop("neighbors", Config.sa1.n_n)))


def main(argv=None):
    """The command line -> exit code: 0, 2 for bad input, 130 when interrupted."""
    args = command_line(argv)
    keep_freed_memory()
    kitti.terminate_as_interrupted()
    try:
        if args.pop("command") == "eval":
            evaluate(**args)
        elif "resume" in args and args.keys() - {"resume", "out", "device"}:
            raise ValueError("--resume goes on with the options the run was begun with; give only --out RUN, and --device")
        else:
            train(config_from(args), **args)
    except KeyboardInterrupt as interruption:
        print(f"\nd3dlo: interrupted; {str(interruption) or 'run it again; a training goes on by train --out RUN --resume'}", file=sys.stderr)
        return 130
    except (ValueError, OSError, BrokenExecutor) as error:
        print(f"d3dlo: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
