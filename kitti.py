"""The data: KITTI odometry scans, calibration, frames, splits, ground plane, simulated city.

A scan is an array (N,4) float32: x, y, z [m] in the Velodyne frame (x forward, y left, z up) and
intensity [0..1]. `T_ab` maps points from frame b to frame a.

KITTI's pose files are in the frame of the rectified left camera. The points are in the Velodyne
frame, so `poses` and `motions()` of a sequence are, too: T_velo = inv(Tr) @ T_cam @ Tr.

The simulated city replaces KITTI where it is not at hand: an HDL-64E drives through 11 small cities
with exact ground truth, 2,620 scans or 4.2 GB. Needs NumPy and SciPy.

    python kitti.py simulate data/city
    python kitti.py simulate data/tiny --sequences 00 07 --scans 40 --azimuth 900
    python kitti.py raw DRIVE data/raw      # convert a drive of KITTI's raw data
"""
import argparse
import ctypes
import functools
import hashlib
import importlib.metadata
import itertools
import json
import os
import platform
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
import warnings
import zlib
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor
from contextlib import closing, contextmanager, suppress
from pathlib import Path

import numpy as np
from scipy.ndimage import distance_transform_edt, gaussian_filter
from scipy.spatial.transform import Rotation

from metrics import path_lengths, read_poses, replacing, temporary_beside, write_poses

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

# Section 4 of the paper
SPLITS = {
    "train": ("00", "01", "02", "08", "09"),
    "test": ("03", "04", "05", "06", "10"),
    "validation": ("07",),
}

# ------------------------------------------------------------------------------------------------
# Files

FIVE_FLOATS = ("nuScenes files have five floats per point: convert each with "
               "np.save(NEW, np.fromfile(OLD, np.float32).reshape(-1, 5)[:, :4])")
OTHER_FORMATS = b"\x93NUMPY", b"ply\n", b"ply\r", b"# .PCD"  # how files of other formats begin


def _check_scan_size(path, size):
    """ValueError unless a .bin file of `size` bytes can hold a scan."""
    if size == 0 or size % 16:
        raise ValueError(f"{path} has {size} bytes, but a scan has 16 (four float32) per point: "
                         f"copy or unpack it again. {FIVE_FLOATS}.")


def read_scan(path: str | Path, intensity_max: float = 1) -> np.ndarray:
    """Read one scan, a .bin or .npy file.

    Returns (N,4) float32: x, y, z [m] in the LiDAR's frame, and the intensity divided by
    `intensity_max`. NaN is kept. A .bin file holds four float32 per point, as KITTI's. A .npy file
    holds an array (N,3) or (N,4); without a fourth column the intensities are 0. Raises OSError
    when the file cannot be read, ValueError when it is empty, damaged or of another format.
    """
    path = Path(path)
    scan = _read_npy(path) if path.suffix == ".npy" else _read_bin(path)
    scan[:, 3] /= intensity_max
    return scan


def _read_bin(path):
    """A .bin file -> scan (N,4) float32."""
    data = path.read_bytes()
    if data.startswith(OTHER_FORMATS):
        raise ValueError(f"{path} is not a KITTI scan but a file of another format: read it with "
                         "its own library and save x, y, z, intensity as .npy.")
    _check_scan_size(path, len(data))
    return np.frombuffer(data, "<f4").reshape(-1, 4).astype(np.float32)  # (N,4), a writable copy


def _read_npy(path):
    """A .npy file -> scan (N,4) float32."""
    try:
        points = np.load(path, allow_pickle=False)
    except OSError:
        raise
    except Exception:  # np.load raises many exception types; all of them mean a corrupt file
        raise ValueError(f"{path} is no NumPy file or is damaged: save the scan again.") from None
    shape = getattr(points, "shape", ())  # an archive of several arrays has no shape
    if (len(shape) != 2 or shape[0] == 0 or shape[1] not in (3, 4)
            or points.dtype.kind not in "fiu"):
        raise ValueError(f"{path} has shape {shape}, but a scan is an array of numbers (N,3) or "
                         "(N,4): save the columns x, y, z and intensity.")
    scan = np.zeros((len(points), 4), np.float32)
    with np.errstate(over="ignore"):  # numbers too large for float32 become infinite
        scan[:, :points.shape[1]] = points
    return scan


def read_calib(path: str | Path) -> np.ndarray:
    """Read the row `Tr` of a sequence's calib.txt.

    Returns T_cam0_velo (4,4) float64, which maps points from the Velodyne frame to the frame of the
    rectified left camera [m]. Raises FileNotFoundError, and ValueError when `Tr` is missing or is
    not 12 finite numbers with a rotation.
    """
    path = Path(path)
    remedy = ("KITTI's is in data_odometry_calib.zip; for drives of your own write the line "
              "Tr: 0 -1 0 0 0 0 -1 0 1 0 0 0")
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist: {remedy}.")
    row = _calib_row(path, "Tr", 12).reshape(3, 4)
    if not _is_rigid(row):
        raise ValueError(f"{path} has no row 'Tr' (Velodyne to camera) of 12 finite numbers, a "
                         f"rotation and a translation: {remedy}.")
    return np.vstack([row, [0, 0, 0, 1]])  # (4,4)


def _calib_row(path, name, count):
    """The numbers (count,) of row `name` in a calibration file, NaN if there is no such row."""
    rows = re.findall(rb"^\s*%s\s*:(.*)$" % name.encode(), path.read_bytes(), re.M)
    try:
        return np.array(rows[0].split(), dtype=float).reshape(count)
    except (IndexError, ValueError):
        return np.full(count, np.nan)


def _is_rigid(row):
    """Whether (3,4) is finite, with a rotation in its first three columns."""
    R = row[:, :3]
    with np.errstate(all="ignore"):  # huge numbers overflow
        deviation = np.abs(R @ R.T - np.eye(3)).max()
        rotation = deviation < 1e-3 and np.linalg.det(R) > 0
    return bool(np.isfinite(row).all() and rotation)


def write_tum(path: str | Path, T: np.ndarray, times: np.ndarray) -> None:
    """Write poses (n,4,4) at `times` (n,) [s] as a TUM trajectory file, through a temporary file.

    A row is t x y z qx qy qz qw, with qw >= 0, in the frame of the poses. Raises ValueError when
    the numbers of poses and times differ, and OSError.
    """
    q = Rotation.from_matrix(T[:, :3, :3]).as_quat(canonical=True)  # (n,4)
    with replacing(path) as temporary, open(temporary, "w", newline="\n") as file:
        np.savetxt(file, np.c_[times, T[:, :3, 3], q], fmt="%.9f")


# ------------------------------------------------------------------------------------------------
# Frames


def invert(T):
    """The inverses of rigid transforms (...,4,4): R^T and -R^T t for R and t.

    Faster and more accurate than a general matrix inverse.
    """
    T = np.asarray(T, dtype=float)
    R_inverse = np.swapaxes(T[..., :3, :3], -1, -2)
    out = np.zeros_like(T)
    out[..., :3, :3] = R_inverse
    out[..., :3, 3:] = -R_inverse @ T[..., :3, 3:]
    out[..., 3, 3] = 1
    return out


def camera_to_velo(T_cam, Tr):
    """Camera poses or motions (...,4,4) -> those of the Velodyne, inv(Tr) @ T_cam @ Tr."""
    return invert(Tr) @ T_cam @ Tr


def velo_to_camera(T_velo, Tr):
    """Velodyne poses or motions (...,4,4) -> those of the camera, Tr @ T_velo @ inv(Tr)."""
    return Tr @ T_velo @ invert(Tr)


def to_vector(T: np.ndarray) -> np.ndarray:
    """Rigid transforms as vectors, section 3.2 of the paper.

    T (...,4,4) -> (...,6) float64: tx, ty, tz [m]; roll, pitch, yaw [degrees], the Euler angles
    about the fixed axes x, y, z in that order.
    """
    T = np.asarray(T, dtype=float)
    flat = T.reshape(-1, 4, 4)
    angles = np.empty((0, 3))
    if len(flat):
        with warnings.catch_warnings():
            # At a pitch of +-90 degrees (gimbal lock), scipy warns and sets the third angle to
            # zero. The rotation is still the same.
            warnings.simplefilter("ignore", UserWarning)
            angles = Rotation.from_matrix(flat[:, :3, :3]).as_euler("xyz", degrees=True)
    vectors = np.concatenate([flat[:, :3, 3], angles], axis=1)
    return vectors.reshape(T.shape[:-2] + (6,))


def from_vector(v: np.ndarray) -> np.ndarray:
    """The inverse of `to_vector`: (...,6) in metres and degrees -> (...,4,4) float64."""
    v = np.asarray(v, dtype=float)
    flat = v.reshape(-1, 6)
    T = np.tile(np.eye(4), (len(flat), 1, 1))
    if len(flat):
        T[:, :3, :3] = Rotation.from_euler("xyz", flat[:, 3:], degrees=True).as_matrix()
    T[:, :3, 3] = flat[:, :3]
    return T.reshape(v.shape[:-1] + (4, 4))


# ------------------------------------------------------------------------------------------------
# Sequences


class Sequence:
    """A sequence of ROOT in KITTI's layout. All its files are checked when it is opened.

    The files are ROOT/sequences/NAME/velodyne/000000.bin ..., ROOT/sequences/NAME/calib.txt and,
    where there is ground truth, ROOT/poses/NAME.txt.

    name, folder: its name and ROOT/sequences/NAME; scan_paths: list of n paths; Tr (4,4):
    T_cam0_velo; poses_cam (n,4,4): the poses as in the file; poses (n,4,4): T_0t in the Velodyne
    frame. Both are None without ground truth. Raises FileNotFoundError for a missing file, and
    ValueError for a damaged one or when the numbers of scans and poses differ.
    """

    intensity_max = 1  # intensities are divided by this; KITTI's are within 0..1

    def __init__(self, root, name):
        self.name = name
        self.folder = Path(root) / "sequences" / name
        velodyne = self.folder / "velodyne"
        self.scan_paths = sorted(velodyne.glob("*.bin"))
        if not self.scan_paths:
            raise FileNotFoundError(f"{velodyne} holds no scans: unpack data_odometry_velodyne.zip "
                                    "over it, other archives have none.")
        for i, path in enumerate(self.scan_paths):
            if path.name != f"{i:06d}.bin":
                raise ValueError(f"{velodyne} should hold {i:06d}.bin next but holds {path.name}: "
                                 "scans are numbered from 000000 without a gap, unpack "
                                 "data_odometry_velodyne.zip again.")
            _check_scan_size(path, path.stat().st_size)
        self.Tr = read_calib(self.folder / "calib.txt")

        self.poses_cam = self.poses = None
        truth = Path(root) / "poses" / f"{name}.txt"
        if truth.exists():
            self.poses_cam = read_poses(truth)  # (n,4,4)
            if len(self.poses_cam) != len(self):
                raise ValueError(f"{truth} has {len(self.poses_cam)} poses but {velodyne} has "
                                 f"{len(self)} scans: the two must agree, unpack whichever is "
                                 "incomplete again.")
            self.poses = camera_to_velo(self.poses_cam, self.Tr)  # (n,4,4)

    def __len__(self):
        return len(self.scan_paths)

    def scan(self, i: int) -> np.ndarray:
        """Scan i as (N,4) float32, see `read_scan`."""
        return read_scan(self.scan_paths[i], self.intensity_max)

    def motions(self) -> np.ndarray:
        """True motions T_{t,t+1} = inv(T_t) @ T_{t+1} (n-1,4,4), eq. 1 of the paper.

        They are in the Velodyne frame and map points of scan t+1 to the frame of scan t. Raises
        ValueError when the sequence has no ground truth.
        """
        if self.poses is None:
            raise ValueError(f"Sequence {self.name} has no ground truth: put it into ROOT/poses/"
                             f"{self.name}.txt beside ROOT/sequences (SemanticKITTI's sequences/"
                             f"{self.name}/poses.txt is not ground truth: SuMa estimated it).")
        return invert(self.poses[:-1]) @ self.poses[1:]


class ScanFolder(Sequence):
    """A plain folder of scans as a sequence: *.bin or *.npy, in natural order (2 before 10).

    name is the folder's. There is no calibration and no ground truth: Tr, poses_cam and poses are
    None. intensity_max is what intensities are divided by, 1 or 255. times (n,) are the seconds in
    the folder's times.txt, or else those of 10 scans a second. notes is a list of lines that say
    what was assumed. Raises ValueError when the files do not fit together or are no scans.
    """

    def __init__(self, folder):
        self.folder = Path(folder)
        self.name = self.folder.resolve().name
        self.scan_paths = scans_in(folder)
        self.Tr = self.poses_cam = self.poses = None
        if len({path.suffix for path in self.scan_paths}) > 1:
            raise ValueError(f"{folder} holds both .bin and .npy files: move one kind elsewhere.")
        for path in self.scan_paths:
            if path.suffix == ".bin":
                _check_scan_size(path, path.stat().st_size)

        self.notes = []
        largest = _largest_intensity(self.scan_paths)
        self.intensity_max = 255 if largest > 1 else 1
        if largest == 0:
            self.notes.append("there are no intensities; zeros are used, so expect larger errors")
        if largest > 1:
            self.notes.append(f"intensities reach {largest:.4g}; all are divided by 255")

        if (self.folder / "times.txt").exists():
            self.times = _read_times(self.folder / "times.txt", len(self))
        else:
            self.times = 0.1 * np.arange(len(self))
            self.notes.append("there is no times.txt, one time in seconds per line; "
                              "10 scans a second are assumed")


def scans_in(folder):
    """The *.bin and *.npy files of a folder, in natural order: list of paths."""
    def with_padded_numbers(path):  # "2.bin" comes before "10.bin"
        return re.sub(r"\d+", lambda digits: digits[0].zfill(20), path.name)

    paths = [path for path in Path(folder).glob("[!.]*") if path.suffix in (".bin", ".npy")]
    return sorted(paths, key=with_padded_numbers)


def _largest_intensity(paths):
    """The largest intensity in ten scans spread over a folder.

    ValueError for one below 0 or above 255, which cannot be an intensity.
    """
    largest = 0
    for i in np.unique(np.linspace(0, len(paths) - 1, 10).astype(int)):
        intensity = read_scan(paths[i])[:, 3]
        intensity = intensity[np.isfinite(intensity)]
        if intensity.min(initial=0) < 0:
            raise ValueError(f"{paths[i]}: the fourth value of a point is {intensity.min():.4g}, "
                             "but no intensity is negative, so these are not x, y, z, intensity. "
                             f"{FIVE_FLOATS}.")
        if intensity.max(initial=0) > 255:
            raise ValueError(f"{paths[i]} has intensities up to {intensity.max():.4g}, but they "
                             "must lie within 0..1 or 0..255: rescale those of all scans.")
        largest = max(largest, intensity.max(initial=0))
    return largest


def _read_times(path, n):
    """The times (n,) [s] in a times.txt, one per line. ValueError unless they increase."""
    try:
        times = np.array(path.read_bytes().split(), dtype=float)
    except ValueError:
        times = np.empty(0)
    if len(times) != n or not np.isfinite(times).all() or (np.diff(times) <= 0).any():
        raise ValueError(f"{path} must hold {n} increasing numbers, the time of each scan in "
                         "seconds: correct it, or remove it to assume 10 scans a second.")
    return times


def _is_plain_folder(root):
    """Whether ROOT is a plain folder of scans and not KITTI's odometry layout."""
    return not (Path(root) / "sequences").exists()


def _is_raw_data(root):
    """Whether ROOT looks like KITTI's raw data, a drive or a folder of drives."""
    paths = root, *root.glob("*"), *root.glob("*/*")
    return any(re.search(r"_drive_\d+|^velodyne_points$", path.name) for path in paths)


def sequence_names(root: str | Path) -> list[str]:
    """The names of the sequences of ROOT that have scans, sorted.

    A plain folder of scans is one sequence with the folder's name. Raises FileNotFoundError when
    there are no scans, or none in a known layout.
    """
    root = Path(root)
    if _is_plain_folder(root) and scans_in(root):
        return [root.resolve().name]
    folders = root.glob("sequences/[!.]*/velodyne")
    names = sorted(folder.parent.name for folder in folders if any(folder.glob("*.bin")))
    if not names:
        remedy = "check the path and unpack its archives"
        if _is_raw_data(root):
            remedy = "convert KITTI's raw data with `python kitti.py raw DRIVE ROOT`"
        raise FileNotFoundError(
            f"{root} has no scans in a known layout: {remedy}. Known are a folder of *.bin or "
            "*.npy files, and KITTI's odometry layout, ROOT/sequences/00/{velodyne/000000.bin, "
            "calib.txt} and ROOT/poses/00.txt.")
    return names


def open_sequences(root: str | Path, names: str | list[str] | None = None) -> list[Sequence]:
    """Open sequences of ROOT, in the order given, each once.

    names: one or several of the folders under ROOT/sequences, the splits of SPLITS (those of their
    sequences that ROOT has), or "all"; None means "all". A ROOT without a folder sequences/ is one
    `ScanFolder`. Raises ValueError for a name that ROOT does not have or a split of which it has
    nothing, and whatever `sequence_names`, `Sequence` and `ScanFolder` raise.
    """
    there = sequence_names(root)
    choices = {}
    for split, members in SPLITS.items():
        choices[split] = [name for name in members if name in there]
    choices["all"] = there
    for name in there:
        choices[name] = [name]

    if names is None:
        names = ["all"]
    elif isinstance(names, str):
        names = [names]
    chosen = {}  # a dict keeps the order
    for name in names:
        if not choices.get(name):
            known = " ".join(choice for choice, members in choices.items() if members)
            raise ValueError(f"{root} has no sequence or split {name!r} with scans: choose from "
                             f"{known}.")
        chosen |= dict.fromkeys(choices[name])
    if _is_plain_folder(root):
        return [ScanFolder(root) for _ in chosen]
    return [Sequence(root, name) for name in chosen]


# ------------------------------------------------------------------------------------------------
# From a scan to a point cloud

BROKEN_RANGE, BROKEN_INTENSITY = 1000.0, 65536  # [m]; no LiDAR returns more
# Scan statistics, used to warn about domain shift
STATS = ("usable points", "mean intensity", "median range of the centroids [m]",
         "share of points in the densest 0.3 m of height (the ground)")


def usable_points(scan, max_range=None, plane=True):
    """The points of a scan that the network is given, and the number of broken points.

    (N,4) -> (M,4) float32, in the same order. Broken points are dropped first: those that are not
    finite, or of a range or intensity that no LiDAR returns. Then points beyond `max_range` metres
    are dropped (None: keep all) and, unless `plane`, the ground. Raises ValueError for another
    shape than (N,4).
    """
    with np.errstate(over="ignore", invalid="ignore"):
        scan = np.asarray(scan, np.float32)
        if scan.ndim != 2 or scan.shape[1] != 4:
            raise ValueError(f"a scan has the shape (N, 4), not {scan.shape}; give x, y, z [m] and "
                             "intensity of N points")
        x, y, z, intensity = scan.T  # (N,) each
        squared_range = x * x + y * y + z * z
        # A comparison with NaN is false
        in_range = squared_range < BROKEN_RANGE**2
        intact = in_range & (np.abs(intensity) < BROKEN_INTENSITY)
        near = squared_range < (max_range or BROKEN_RANGE) ** 2
    broken = np.count_nonzero(~intact)
    kept = scan[intact & near]  # (M,4)
    if not plane:
        kept = remove_plane(kept)
    return kept, broken


def scan_stats(scan, centroids):
    """Usable points (M,4) and the centroids sampled from them (S,3) -> STATS (4,) of the scan."""
    height = np.clip(scan[:, 2], -100, 100)
    layer = np.floor(height / 0.3).astype(int)  # (M,)
    points_in_layer = np.bincount(layer - layer.min())
    ground_share = points_in_layer.max() / len(scan)
    centroid_range = np.linalg.norm(centroids, axis=1)  # (S,)
    mean_intensity = scan[:, 3].mean(dtype=float)
    return np.array([len(scan), mean_intensity, np.median(centroid_range), ground_share])


def domain_shift(stats, seen):
    """Which statistics of a scan lie outside the range seen in training, by a factor of 1.5.

    stats: STATS (4,); seen (2,4): their least and largest values in training. Returns a text that
    names them, empty if there are none.
    """
    shifts = []
    for name, x, low, high in zip(STATS, stats, *seen):
        if not low / 1.5 <= x <= high * 1.5:
            shifts.append(f"{name} {x:.3g} (in training {low:.3g} to {high:.3g})")
    return "; ".join(shifts)


def remove_plane(scan: np.ndarray, threshold=0.15, max_tilt=15.0, hypotheses=400, subsample=4000,
                 seed=0) -> np.ndarray:
    """Remove the ground plane from a scan by RANSAC, section 4 of the paper.

    (N,3) or more columns -> the points that are `threshold` metres or more away from the dominant
    plane whose normal is within `max_tilt` degrees of vertical. `hypotheses` planes through three
    random points are scored on `subsample` random points; the best is fitted twice to all its
    inliers. Order and non-finite points are kept. The scan is unchanged when no plane qualifies.
    """
    rng = np.random.default_rng(seed)
    xyz = np.ascontiguousarray(scan[:, :3], dtype=np.float32)  # (N,3)
    finite = np.flatnonzero(np.isfinite(xyz).all(axis=1))
    if len(finite) < 3:
        return scan
    min_cosine = np.cos(np.radians(max_tilt))

    # Hypotheses: planes normal . x = offset through three random points a, b, c
    triples = finite[rng.integers(len(finite), size=(3, hypotheses))]
    a, b, c = xyz[triples].astype(float)  # (H,3) each
    normal = np.cross(b - a, c - a)  # (H,3)
    length = np.linalg.norm(normal, axis=1)
    upright = np.abs(normal[:, 2]) > min_cosine * np.maximum(length, 1e-9)
    if not upright.any():
        return scan
    normal = normal[upright] / length[upright, None]
    offset = (normal * a[upright]).sum(axis=1)  # (H,)

    # Score them by the number of inliers among M random points
    sample = xyz[finite[rng.integers(len(finite), size=min(subsample, len(finite)))]]  # (M,3)
    projected = normal.astype(np.float32) @ sample.T  # (H,M)
    distance = np.abs(projected - offset[:, None].astype(np.float32))  # (H,M)
    best = (distance < threshold).sum(axis=1).argmax()
    n, d = normal[best], offset[best]

    def inliers(n, d):  # (N,) bool
        with np.errstate(invalid="ignore", over="ignore"):  # NaN is never an inlier
            return np.abs(xyz @ n.astype(np.float32) - np.float32(d)) < threshold

    # Least squares: the normal is the direction in which the inliers vary least
    for _ in range(2):
        points = xyz[inliers(n, d)]
        if len(points) < 3:
            return scan
        mean = points.mean(axis=0, dtype=float)
        centred = points - mean.astype(np.float32)
        covariance = (centred.T @ centred).astype(float)  # (3,3), but for a factor
        _, directions = np.linalg.eigh(covariance)  # by increasing variance
        n = directions[:, 0]
        d = n @ mean
    if abs(n[2]) < min_cosine:  # a wall, for example
        return scan
    return scan[~inliers(n, d)]


# ------------------------------------------------------------------------------------------------
# Long work: progress, processes, signals, folders of training runs


def progress(items, total, what):
    """Yield the items, and say on stderr how many of `total` are done, how fast, and what is left.

    On a terminal the line is rewritten in place. Elsewhere a line is printed every 10 s, or after
    every tenth of the time so far when that is longer.
    """
    tty = sys.stderr.isatty()
    began, done = time.monotonic(), 0
    due = began + (0.2 if tty else 10)  # time of the next message [s]

    def say(end):
        rate = done / max(time.monotonic() - began, 1e-9)
        minutes, seconds = divmod(round((total - done) / rate), 60)
        line = f"{what}: {done}/{total}, {rate:.3g} /s, {minutes}:{seconds:02d} left"
        if tty:
            line = f"\r{line:<79}"
        print(line, end=end, file=sys.stderr, flush=True)

    try:
        for item in items:
            now = time.monotonic()
            if done and now > due:
                say("" if tty else "\n")
                due = now + (0.2 if tty else max(10, (now - began) / 10))
            yield item
            done += 1
    finally:
        if done:
            say("\n")


def cores():
    """Number of cores this process may use, at most 61: Windows allows no more worker processes."""
    if hasattr(os, "sched_getaffinity"):
        count = len(os.sched_getaffinity(0))
    else:
        count = os.cpu_count() or 1
    return min(count, 61)


def in_processes(function, tasks, workers=None, chunksize=4):
    """Yield function(task) for every task, in order, computed by a pool of worker processes.

    workers: number of processes, None for one per core; chunksize: tasks sent to a worker at once.
    Raises OSError when a worker died.
    """
    pool = ProcessPoolExecutor(workers or cores(), initializer=_leave_signals_to_parent)
    try:
        yield from pool.map(function, tasks, chunksize=chunksize)
    except BrokenExecutor:
        raise OSError("a worker process died. Where processes are spawned, as on macOS and "
                      "Windows, a script needs the line if __name__ == '__main__': before its main "
                      "part. Otherwise check the free memory") from None
    finally:
        pool.shutdown(cancel_futures=True)


def _leave_signals_to_parent():
    """Let a worker ignore Ctrl-C, which the parent handles, and end at SIGTERM."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)


def terminate_as_interrupted():
    """Treat SIGTERM like Ctrl-C from now on, so that every `finally` runs."""
    if threading.current_thread() is threading.main_thread():  # Python's rule for signals
        signal.signal(signal.SIGTERM, signal.default_int_handler)


def keep_freed_memory():
    """Let glibc keep large freed blocks instead of returning them to the system.

    Otherwise every allocation faults its pages in again, a third of the time of a training step on
    a CPU.
    """
    try:
        libc = ctypes.CDLL(None)
        libc.mallopt(-4, 0)  # M_MMAP_MAX: large blocks come from the heap too
        libc.mallopt(-1, 2**31 - 1)  # M_TRIM_THRESHOLD: the heap never shrinks
    except (OSError, AttributeError, TypeError):  # another C library
        pass


def versions(folder):
    """Versions of Python and the packages, and the git commit of the code in `folder`, if any."""
    commit = None
    git = shutil.which("git")
    if git and (Path(folder) / ".git").exists():
        describe = [git, "-C", folder, "describe", "--always", "--dirty"]
        commit = subprocess.run(describe, capture_output=True, text=True).stdout.strip()
    packages = {name: importlib.metadata.version(name) for name in ("numpy", "scipy", "torch")}
    return {"commit": commit, "python": platform.python_version(), **packages}


def new_name(parent):
    """A path PARENT/TIME that does not exist yet."""
    path = first = Path(parent) / time.strftime("%Y-%m-%d-%H%M%S")
    for i in itertools.count(2):
        if not path.exists():
            return path
        path = first.with_name(f"{first.name}-{i}")


@contextmanager
def run_folder(path):
    """Make a folder and hold it for one writer. If it is new and still empty at the end, remove it.

    The holder locks the file PATH/lock, which nothing else opens. The system unlocks it when the
    process ends, in whatever way. Without fcntl, as on Windows, nothing is locked. Raises
    ValueError while another process holds the folder.
    """
    made = [folder for folder in (path, *path.parents) if not folder.exists()]
    path.mkdir(parents=True, exist_ok=True)
    with open(path / "lock", "a+", encoding="utf-8") as lock:
        if fcntl:
            try:
                fcntl.lockf(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                lock.seek(0)
                holder = lock.read().strip() or "just started"
                raise ValueError(f"{path}: another training run writes to it, {holder}; wait for "
                                 "its end, or choose another folder") from None
        lock.truncate(0)
        lock.write(f"process {os.getpid()} on {platform.node()}\n")
        lock.flush()
        try:
            yield
        finally:
            if made and [file.name for file in path.iterdir()] == ["lock"]:
                (path / "lock").unlink()
                with suppress(OSError):  # another process has just begun to use it
                    for folder in made:
                        folder.rmdir()


@contextmanager
def delayed_interrupt():
    """Delay Ctrl-C and SIGTERM: yield a list to which a signal is added instead of interrupting.

    A second signal interrupts at once. Outside the main thread, where Python does not let us handle
    signals, nothing is delayed.
    """
    received, handlers = [], {}

    def note(number, frame):
        if received:
            raise KeyboardInterrupt
        received.append(number)

    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):
            handlers[number] = signal.signal(number, note)
    try:
        yield received
    finally:
        for number, handler in handlers.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)


# ------------------------------------------------------------------------------------------------
# Cache


def cached_records(sequences, compute, dtype, settings, cache="cache"):
    """Compute a record for every scan, once: later calls read the records from files.

    sequences: a list of `Sequence`; compute: a function from a scan (N,4) to a record of `dtype`,
    which can be pickled; settings: everything else that the records depend on. Returns two lists
    with an entry for each sequence: records (n,), memory-mapped, and the CRC-32 of every scan (n,)
    uint32, from which `fingerprint` identifies the data.

    A file's name is a hash of the settings and of the path, size and times of every scan, so a
    stale file is never read. A damaged file is made again. Files are moved into place when they are
    complete, so two processes may share a cache. All cores share the work. Raises ValueError,
    naming the file, for a scan that `compute` refuses.
    """
    row_dtype = np.dtype([("record", dtype), ("scan_crc", "u4"), ("crc", "u4")])
    files = [Path(cache) / f"{s.name}-{_cache_key(s, settings, dtype)}.npy" for s in sequences]
    missing = [(s, file) for s, file in zip(sequences, files)
               if not _is_intact(file, row_dtype, len(s))]
    if missing:
        _write_cache(missing, compute, row_dtype)
    loaded = [np.load(file, mmap_mode="r") for file in files]
    records = [rows["record"] for rows in loaded]
    scan_crcs = [np.array(rows["scan_crc"]) for rows in loaded]
    return records, scan_crcs


def _write_cache(missing, compute, row_dtype):
    """Compute and write the cache files of a list of (sequence, file)."""
    tasks = [(path, s.intensity_max) for s, _ in missing for path in s.scan_paths]
    compute_row = functools.partial(_cache_row, compute=compute, row_dtype=row_dtype)
    with closing(in_processes(compute_row, tasks)) as rows:
        rows = progress(rows, len(tasks), "sampling and grouping, scans")
        for s, file in missing:
            header = {"descr": np.lib.format.dtype_to_descr(row_dtype), "fortran_order": False,
                      "shape": (len(s),)}
            # Written row by row: a memory map would crash on a full disk
            with replacing(file) as temporary, open(temporary, "wb") as out:
                np.lib.format.write_array_header_1_0(out, header)
                for _ in range(len(s)):
                    out.write(next(rows))
        next(rows, None)  # lets the progress line end


def _cache_key(sequence, settings, dtype):
    """Hash of everything a cache file depends on.

    The ctime of a scan changes even when its size and modification time are kept.
    """
    stats = [os.stat(path) for path in sequence.scan_paths]
    scans = [(s.st_size, s.st_mtime_ns, s.st_ctime_ns) for s in stats]
    depends = str(sequence.folder.resolve()), scans, sequence.intensity_max, settings, dtype.descr
    return hashlib.sha256(repr(depends).encode()).hexdigest()[:16]


def _cache_row(task, compute, row_dtype):
    """(path of a scan, intensity_max) -> the bytes of its row in a cache file."""
    path, intensity_max = task
    scan = read_scan(path, intensity_max)
    row = np.zeros((), row_dtype)
    row["scan_crc"] = zlib.crc32(scan)
    try:
        row["record"] = compute(scan)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    row["crc"] = zlib.crc32(row.tobytes()[:-4])  # of the row without its last field, the CRC
    return row.tobytes()


def _is_intact(file, row_dtype, n):
    """Whether a cache file exists, holds n rows and has the right checksums.

    Says so on stderr when the file is damaged.
    """
    if not file.is_file():
        return False
    try:
        rows = np.load(file, mmap_mode="r")  # pickles are off by default, so no code runs
        if rows.dtype == row_dtype:
            content = rows.view(np.uint8).reshape(n, -1)  # (n,bytes of a row)
            if all(zlib.crc32(row[:-4]) == crc for row, crc in zip(content, rows["crc"])):
                return True
    except Exception:  # np.load raises many exception types; all of them mean a corrupt file
        pass
    print(f"{file}: damaged, so it is made again", file=sys.stderr)
    return False


def fingerprint(sequence, scan_crcs):
    """16 hex digits that identify a sequence by its content: the CRC of every scan, and the poses.

    They do not depend on the folder or on file times.
    """
    poses = b"" if sequence.poses_cam is None else sequence.poses_cam.tobytes()
    return hashlib.sha256(scan_crcs.tobytes() + poses).hexdigest()[:16]


# ------------------------------------------------------------------------------------------------
# KITTI's raw drives: readme.txt of the raw data devkit, and oxts/dataformat.txt of each drive

EARTH_RADIUS = 6378137.0  # [m]; devkit: latlonToMercator.m
# Columns of a GPS/IMU packet
LAT_LON_ALT = slice(0, 3)  # degrees, degrees, m
ROLL_PITCH_YAW = slice(3, 6)  # rad
VELOCITY = [7, 6, 10]  # m/s to the east, to the north and upwards
TURN_RATE = slice(17, 20)  # rad/s about the unit's x, y and z axes
MAX_DELAY = np.timedelta64(100, "ms")  # a scan farther from every packet has no pose
SECOND = np.timedelta64(1, "s")


def convert_raw(drive: str | Path, root: str | Path) -> dict[str, tuple[int, int]]:
    """Convert an unpacked "sync" drive of KITTI's raw data to odometry layout, with ground truth.

    `drive` is a folder such as 2011_09_26/2011_09_26_drive_0013_sync, with the date's calib_*.txt
    in its parent folder. Writes the folder ROOT/sequences/2011_09_26_drive_0013 and the ground
    truth ROOT/poses/2011_09_26_drive_0013.txt, in the rectified left camera's frame. Scans are hard
    links where the file system allows it, else copies. A drive in which scans are missing is split
    at the gaps, into sequences with -1, -2 ... behind their names. Returns {name of a sequence:
    (number of its first scan in the drive, of its last)}.

    A pose is that of the time in velodyne_points/timestamps.txt: the middle of the scanner's turn,
    when it faces forward and triggers the cameras. The "sync" data is aligned to this time. The
    GPS/IMU packet of a scan was recorded at another time, 12 to 25 ms later in drive 0013. So the
    nearest packet is moved by its own velocity and turn rate to the time of the scan. The points
    are used as they are: those of a turn were measured over 0.1 s.

    Raises FileNotFoundError for a missing file, naming its archive, and ValueError for a damaged
    one or when ROOT holds such a sequence already. ROOT is then unchanged.
    """
    drive, root = Path(drive), Path(root)
    match = re.fullmatch(r"((\d{4}_\d\d_\d\d)_drive_\d+)_sync", drive.resolve().name)
    if not match:
        raise ValueError(f"{drive} is no drive of KITTI's raw data: give a folder such as "
                         "2011_09_26/2011_09_26_drive_0013_sync, of the synced+rectified data.")
    name, date = match.groups()
    archive = f"{name}_sync.zip"
    numbers, scans, times = _raw_stream(drive / "velodyne_points", ".bin", archive)
    _, packets, packet_times = _raw_stream(drive / "oxts", ".txt", archive)
    Tr, T_velo_imu = _raw_calib(drive.resolve().parent, f"{date}_calib.zip")
    for path in scans:
        _check_scan_size(path, path.stat().st_size)

    # The nearest packet of each scan
    nearest = np.array([np.abs(packet_times - t).argmin() for t in times])  # (n,)
    delay = times - packet_times[nearest]  # (n,)
    has_pose = np.flatnonzero(np.abs(delay) < MAX_DELAY)
    if not len(has_pose):
        raise ValueError(f"{drive}: no scan was taken within 0.1 s of a GPS/IMU packet; "
                         f"unpack {archive} again.")

    # Split the scans at the gaps; each run of consecutive scans becomes a sequence
    gaps = np.flatnonzero(np.diff(numbers[has_pose]) != 1) + 1
    runs = np.split(has_pose, gaps)
    names = [name] if len(runs) == 1 else [f"{name}-{i + 1}" for i in range(len(runs))]
    parts = dict(zip(names, runs))

    packets = np.stack([_read_packet(path) for path in packets])  # (m,30)
    T_imu = _imu_poses(packets, nearest, delay / SECOND)  # (n,4,4)

    folders = {part: root / "sequences" / part for part in parts}
    truths = {part: root / "poses" / f"{part}.txt" for part in parts}
    for path in (*folders.values(), *truths.values()):
        if path.exists():
            raise ValueError(f"{path} is there already: remove it or choose another ROOT.")
    temporary = {part: temporary_beside(folder) for part, folder in folders.items()}
    try:
        for part, run in parts.items():
            _write_raw_sequence(temporary[part], [scans[i] for i in run], Tr, times[run])
        for part, run in parts.items():
            T = invert(T_imu[run[0]]) @ T_imu[run]  # relative to the first pose
            T_cam = velo_to_camera(T, Tr @ T_velo_imu)  # from the IMU's frame to the camera's
            write_poses(truths[part], T_cam)
            temporary[part].rename(folders[part])
    finally:
        for folder in temporary.values():
            shutil.rmtree(folder, ignore_errors=True)
    return {part: (int(numbers[run[0]]), int(numbers[run[-1]])) for part, run in parts.items()}


def _write_raw_sequence(folder, scans, Tr, times):
    """Write the scans, calib.txt and times.txt of a sequence in odometry layout."""
    shutil.rmtree(folder, ignore_errors=True)  # left by an earlier process with the same id
    (folder / "velodyne").mkdir(parents=True)
    for i, scan in enumerate(progress(scans, len(scans), "linking or copying scans")):
        target = folder / "velodyne" / f"{i:06d}.bin"
        try:
            os.link(scan.resolve(), target)
        except OSError:  # another file system, or one without links
            shutil.copyfile(scan, target)
    row = " ".join(f"{x:.12e}" for x in Tr[:3].ravel())
    (folder / "calib.txt").write_text(f"Tr: {row}\n")
    seconds = (times - times[0]) / SECOND
    (folder / "times.txt").write_text("".join(f"{t:.6f}\n" for t in seconds))


def _require_file(path, archive):
    """FileNotFoundError, naming the archive it is in, when one of KITTI's files is missing."""
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist: it is in {archive}.")


def _raw_stream(folder, suffix, archive):
    """The files of a stream that have a time: numbers (n,), paths (list), times (n,).

    Line i of timestamps.txt, from 0, is the time of file i, to the nanosecond. It is blank where
    the recording has lost a file, as in drive 2011_09_26_drive_0009.
    """
    stamps = folder / "timestamps.txt"
    paths = sorted(path for path in folder.glob(f"data/*{suffix}") if path.stem.isdecimal())
    _require_file(stamps, archive)
    _require_file(paths[0] if paths else folder / "data" / f"0000000000{suffix}", archive)
    numbers = np.array([int(path.stem) for path in paths])
    try:
        lines = [line.strip() for line in stamps.read_text().splitlines()]
        times = np.array(lines, "datetime64[ns]")[numbers]  # a blank line becomes NaT
    except (ValueError, IndexError):
        times = np.full(len(paths), np.datetime64("NaT"))
    known = np.flatnonzero(~np.isnat(times))
    if not len(known):
        raise ValueError(f"{stamps} is damaged: line i should hold the time of file i, such as "
                         f"2011-09-26 13:10:51.158069617; unpack {archive} again.")
    return numbers[known], [paths[i] for i in known], times[known]


def _read_packet(path):
    """A GPS/IMU packet: (30,) numbers in the order of oxts/dataformat.txt."""
    try:
        packet = np.array(path.read_bytes().split(), dtype=float).reshape(30)
    except ValueError:
        packet = np.full(30, np.nan)
    if not np.isfinite(packet).all():
        raise ValueError(f"{path} is damaged: a GPS/IMU packet is 30 finite numbers; "
                         "unpack the drive again.")
    return packet


def _raw_calib(folder, archive):
    """The calib_*.txt of a date -> Tr (4,4), from Velodyne to rectified camera, and T_velo_imu."""
    def transform(name, rotation, translation=None):
        path = folder / name
        _require_file(path, archive)
        R = _calib_row(path, rotation, 9).reshape(3, 3)
        t = _calib_row(path, translation, 3) if translation else np.zeros(3)
        row = np.column_stack([R, t])  # (3,4)
        if not _is_rigid(row):
            raise ValueError(f"{path} is damaged: its row {rotation!r} should hold a rotation, "
                             f"and 'T' a translation; unpack {archive} again.")
        return np.vstack([row, [0, 0, 0, 1]])  # (4,4)

    rectify = transform("calib_cam_to_cam.txt", "R_rect_00")
    T_cam_velo = transform("calib_velo_to_cam.txt", "R", "T")
    T_velo_imu = transform("calib_imu_to_velo.txt", "R", "T")
    return rectify @ T_cam_velo, T_velo_imu


def _imu_poses(packets, nearest, delay):
    """Poses T_wi (n,4,4) of the GPS/IMU unit (x forward, y left, z up) at the times of the scans.

    packets (m,30); nearest (n,): the packet nearest to each scan; delay (n,): time from the packet
    to the scan [s]. The world is x east, y north, z up, in metres.

    The pose of a packet is that of the devkit's convertOxtsToPose.m: a Mercator projection with
    the scale of the drive's first latitude, and roll, pitch, yaw about x, y, z in that order.
    From there, velocity and turn rate are constant: the unit moves along an arc, and the chord of
    the arc has the direction of the velocity half-way.
    """
    scale = EARTH_RADIUS * np.cos(np.radians(packets[0, 0]))
    packets, delay = packets[nearest], delay[:, None]  # (n,30), (n,1)
    lat, lon, alt = packets[:, LAT_LON_ALT].T
    east = scale * np.radians(lon)
    north = scale * np.log(np.tan(np.radians(90 + lat) / 2))
    position = np.stack([east, north, alt], axis=1)  # (n,3)
    attitude = Rotation.from_euler("xyz", packets[:, ROLL_PITCH_YAW])
    turn = attitude.apply(packets[:, TURN_RATE]) * delay  # (n,3) rotation vectors, world's axes
    half_turn = Rotation.from_rotvec(turn / 2)
    T = np.tile(np.eye(4), (len(packets), 1, 1))  # (n,4,4)
    T[:, :3, :3] = (Rotation.from_rotvec(turn) * attitude).as_matrix()
    T[:, :3, 3] = position + half_turn.apply(packets[:, VELOCITY] * delay)
    return T


# ---------------------------------------------------------------------------------------------------- the simulated city
# The world is vertical prisms on a ground, one row each: yawed boxes and upright cylinders. It is flat, and hills bend it afterwards.
# In m and radians; FUZZ is the depth [m] to which foliage lets light in, ROUND is 1 for a cylinder.
X, Y, YAW, HALF_X, HALF_Y, Z0, Z1, ALBEDO, FUZZ, ROUND = range(10)
CITY = 3  # one more when the city changes, so that scans of two versions are never mixed
ELEVATION = np.radians(np.r_[np.linspace(-24.33, -8.83, 32), np.linspace(-8.33, 2.0, 32)])  # the HDL-64E's 64 beams, bottom to top
SENSOR_HEIGHT, MIN_RANGE, CITY_RANGE = 1.73, 2.5, 80.0  # m
LANE = 3.5  # m; we keep to the right lane of two, so the road reaches from 1.75 m right to 5.25 m left of our path
CELL = 0.5  # m, of the ground's raster
RELIEF = 0.4  # m, depth of windows and doors in what is higher than 3 m
# what a sequence is like: cruising speed [m/s], odds of a street corner every 35-80 m (faster: further), stops, and
# odds of (dense, suburban, open) surroundings
STYLES = {"00": (12, 0.55, 0, (6, 3, 1)), "01": (26, 0.15, 0, (1, 3, 12)), "02": (15, 0.4, 0, (1, 6, 2)), "08": (12, 0.5, 1, (4, 4, 1)),
          "09": (19, 0.3, 0, (1, 3, 5)), "03": (10, 0.5, 0, (2, 5, 2)), "04": (18.5, 0.2, 0, (3, 3, 3)), "05": (12, 0.55, 1, (6, 3, 1)),
          "06": (16, 0.4, 0, (3, 5, 1)), "10": (13, 0.5, 1, (2, 4, 3)), "07": (12, 0.5, 1, (6, 3, 1))}


def _drive(rng, scans, style):
    """A road and a drive on it -> at(s, left=0): x, y, heading at `s` metres along the road; s_of(t): metres at t [s]; its length [m]."""
    cruise, corners, stops, _ = style
    ds, start, length = 0.25, 100.0, 100 + 0.13 * cruise * scans + 150  # m; road before and behind us for what we see there
    pieces = []  # length [m], curvature [1/m], speed [m/s]: straight ahead, a bend, perhaps a street corner
    while sum(piece[0] for piece in pieces) < length:
        stretch, speed = rng.uniform(35, 80) * max(cruise / 15, 1) ** 2, cruise * rng.uniform(0.75, 1.0)
        bend = rng.choice([-1, 1]) * rng.choice([0.0, rng.uniform(1.0, 2.8)]) / speed ** 2  # up to 2.8 m/s2 sideways
        arc = min(rng.uniform(0.5, 0.8) * stretch, np.radians(60) / max(abs(bend), 1e-6))
        radius, angle = rng.choice([-1, 1]) * rng.uniform(7, 12), np.radians(rng.uniform(70, 100)) * (rng.random() < corners)
        pieces += [(stretch - arc, 0.0, speed), (arc, bend, speed), (abs(radius) * angle, 1 / radius, speed)]
    metres, curvature, limit = np.array(pieces).T
    curvature, limit = (np.repeat(x, np.round(metres / ds).astype(int)) for x in (curvature, limit))
    smooth = lambda x, metres: gaussian_filter(x, metres / ds, mode="nearest")
    k = smooth(curvature, 1.7) + smooth(rng.normal(0, 0.01, len(curvature)), 8)  # nobody turns the wheel at once, or holds it still
    s = np.arange(len(k)) * ds
    v = np.minimum(limit, np.sqrt(rng.uniform(2.8, 3.6) / np.maximum(np.abs(k), 1e-4)))
    halts = start + 0.07 * cruise * scans * rng.uniform(0.2, 1, stops)
    for h in halts:
        v[abs(s - h) < 1] = 0.4
    for order in (range(1, len(v)), range(len(v) - 2, -1, -1)):  # speeding up takes room, and so does braking: 2.2 m/s2
        for i in order:
            v[i] = min(v[i], np.sqrt(v[i - order.step] ** 2 + 2 * 2.2 * ds))
    t = np.r_[0, np.cumsum(ds / smooth(v, 1.0))[:-1]]
    for h in halts:
        t[s > h] += rng.uniform(0.5, 2.0)  # standing
    t -= np.interp(start, s, t)
    heading = np.cumsum(k) * ds
    x, y = np.cumsum(np.cos(heading)) * ds, np.cumsum(np.sin(heading)) * ds

    def at(q, left=0.0):
        h = np.interp(q, s, heading)
        return np.interp(q, s, x) - left * np.sin(h), np.interp(q, s, y) + left * np.cos(h), h
    return at, lambda q: np.interp(q, t, s), s[-1]


def _ego(rng, at, s_of, scans):
    """The Velodyne's poses T_wt (scans,4,4): it follows the road and its car leans, nods and shakes."""
    t = np.arange(scans) * 0.1
    wave = lambda size, low, high: sum(size / 2 * np.sin(2 * np.pi * rng.uniform(low, high) * t + rng.uniform(0, 6.3)) for _ in range(5))
    s = np.array([s_of(t + d) for d in (-0.2, 0, 0.2)])
    speed, push = (s[2] - s[0]) / 0.4, (s[2] - 2 * s[1] + s[0]) / 0.04  # m/s, m/s2
    x, y, yaw = at(s[1])
    lean = speed * (at(s[2])[2] - at(s[0])[2]) / 0.4  # m/s2 sideways
    shake = np.minimum(speed / 8, 1)  # nothing shakes when we stand
    roll = np.radians(0.25 * lean + shake * (wave(0.25, 0.2, 0.8) + wave(0.12, 1, 2.5)))
    pitch = np.radians(-0.2 * gaussian_filter(push, 2) + shake * (wave(0.25, 0.2, 0.8) + wave(0.14, 1, 2.5)))
    T = np.tile(np.eye(4), (scans, 1, 1))
    T[:, :3, :3] = Rotation.from_euler("xyz", np.stack([roll, pitch, yaw], axis=1)).as_matrix()
    ahead = 0.8  # m: the Velodyne sits before the rear axle, which is what follows the road, so a turn also pushes it sideways
    T[:, :3, 3] = np.stack([x + ahead * np.cos(yaw), y + ahead * np.sin(yaw), SENSOR_HEIGHT + shake * wave(0.015, 0.3, 1.5)], axis=1)
    return T


def _hills(rng, T):
    """The land: height(x, y) [m], the sum of waves 80 to 400 m long, slopes of some 3 % (rms). Then the poses T_wt (n,4,4) of the flat
    world upon it: lifted, and tilted with the slope."""
    k = 2 * np.pi / np.geomspace(80, 400, 6)  # rad/m
    way, phase = rng.uniform(0, 2 * np.pi, (2, 6))
    waves = np.stack([k * np.cos(way), k * np.sin(way), phase, 0.017 / k], axis=1).tolist()
    height = lambda x, y: sum(size * np.sin(kx * x + ky * y + phase) for kx, ky, phase, size in waves)
    x, y, d = T[:, 0, 3], T[:, 1, 3], 0.5
    slope = np.stack([height(x, y + d) - height(x, y - d), height(x - d, y) - height(x + d, y), 0 * x], axis=1) / (2 * d)
    T_hills = T.copy()
    T_hills[:, :3, :3] = Rotation.from_rotvec(slope).as_matrix() @ T[:, :3, :3]
    T_hills[:, 2, 3] += height(x, y)
    return height, T_hills


def _rows(*columns):
    return np.stack(np.broadcast_arrays(*[np.asarray(c, dtype=float) for c in columns]), axis=-1).reshape(-1, 10)


def _cars(x, y, yaw, looks):
    """Cars (n,) -> (2n,10) prisms: a body one can look under, and a cabin of which the windows return little."""
    length, height, albedo = looks
    waist, back = np.where(height > 1.9, 0.5 * height, 0.9), 0.08 * length
    body = _rows(x, y, yaw, length / 2, 0.88, 0.25, waist, albedo, 0, 0)
    x, y = x - back * np.cos(yaw), y - back * np.sin(yaw)
    return np.concatenate([body, _rows(x, y, yaw, 0.29 * length, 0.78, waist, height, 0.6 * albedo, 0, 0)])


def _looks(rng, n=None):
    """Length [m], height [m], albedo of n cars (3,n): an eighth are vans, many are dark."""
    van = rng.random(n) < 0.12
    return np.stack([np.where(van, rng.uniform(5, 6.5, n), rng.uniform(3.6, 4.8, n)),
                     np.where(van, rng.uniform(2, 2.8, n), rng.uniform(1.4, 1.6, n)), 0.02 + 0.5 * rng.random(n) ** 2])


class _Street:
    """What stands on one side of a road of `length` m: `out` collects prisms, `zone(s)` is 0 dense, 1 suburban, 2 open at s metres."""

    def __init__(self, rng, at, length, side, edge, zones):
        self.rng, self.at, self.length, self.out = rng, at, length, []
        self.side, self.edge, self.zone = side, edge, lambda s: zones[int(s / 70)]  # side: 1 left, -1 right; edge [m] of the road

    def put(self, s, left, half_x, half_y, z0, z1, albedo, fuzz=0.0, round_=0, twist=0.0):
        x, y, yaw = self.at(s, left)
        self.out.append(_rows(x, y, yaw + twist, half_x, half_y, z0, z1, albedo, fuzz, round_))

    def tree(self, s, left):
        u = self.rng.uniform
        radius, crown = u(0.1, 0.3), u(1.2, 3.2)
        self.put(s, left, radius, radius, 0, crown + 1, u(0.15, 0.35), round_=1)
        self.put(s, left, r := u(1.2, 3.5), r, crown, crown + u(3, 7), u(0.2, 0.45), fuzz=u(0.5, 2.5), round_=1)

    def plots(self):
        """Houses and gardens, one plot after the other."""
        rng, u, put, side, edge, s = self.rng, self.rng.uniform, self.put, self.side, self.edge, 0.0
        while s < self.length:
            kind = self.zone(s)
            plot = u(9, 22) if kind == 0 else u(9, 16)
            back = edge + (u(3.5, 7) if kind == 0 else u(6, 14) if kind == 1 else u(8, 30))  # where the facade is
            mid, shade, depth = s + plot / 2, u(0.2, 0.42), u(7, 13)
            if rng.random() < (0.95, 0.8, 0.3)[kind]:
                put(mid, side * (back + depth / 2), plot / 2, depth / 2, 0, u(5, 14), shade, twist=rng.normal() * 0.02)
                for _ in range(rng.integers(2, 6)):  # bays, stairs, porches: without relief a street looks the same from metre to metre
                    along, out_by = mid + u(-0.45, 0.45) * plot, u(0.1, 0.5)
                    put(along, side * (back - out_by), u(0.3, 1.5), out_by, 0, u(1, 7), shade * u(0.7, 1.3))
            if kind and rng.random() < 0.65:  # the border of the plot: a hedge, a wall or a fence
                thick, fuzz = (0.35, 0.25) if rng.random() < 0.6 else (0.1, 0)
                put(mid, side * (edge + u(2.2, 3.2)), plot * u(0.3, 0.48), thick, 0, u(0.6, 1.9), u(0.2, 0.4), fuzz)
            for _ in range(rng.poisson((0.6, 2, 2)[kind])):  # trees and bushes of the garden
                self.tree(s + u(0, 1) * plot, side * u(edge + 3, back + 3))
                put(s + u(0, 1) * plot, side * (edge + u(3, 7)), r := u(0.4, 1.2), r, 0, u(0.5, 1.8), u(0.2, 0.4), fuzz=0.25, round_=1)
            s += plot + (u(5, 14) if kind or rng.random() < 0.35 else u(0, 1))  # a gap, at times a side street

    def parked_cars(self):
        rng, s = self.rng, 0.0
        while s < self.length:
            looks = _looks(rng)
            if rng.random() < (0.55, 0.35, 0.06)[self.zone(s)]:
                x, y, yaw = self.at(s, self.side * (self.edge + rng.uniform(1.0, 1.3)))
                self.out.append(_cars(x, y, yaw + rng.normal() * 0.03, looks))
            s += looks[0] + rng.uniform(0.6, 3)

    def pavement(self):
        """Trees, lamps, signs and boxes."""
        rng, u, side, edge, s = self.rng, self.rng.uniform, self.side, self.edge, 0.0
        while s < self.length:
            what = rng.random()
            if what < 0.35:
                self.tree(s, side * (edge + u(2.2, 3)))
            elif what < 0.7:
                self.put(s, side * (edge + u(0.5, 2.5)), r := u(0.04, 0.12), r, 0, u(2.5, 8), u(0.2, 0.6), round_=1)
            elif what < 0.9:
                self.put(s, side * (edge + u(2.2, 3)), u(0.2, 0.6), u(0.2, 0.4), 0, u(0.7, 1.7), u(0.1, 0.6))
            s += u(3, 14)

    def distance(self):
        """What one sees between the houses, on both sides."""
        rng, u = self.rng, self.rng.uniform
        for _ in range(int(self.length / 2)):
            s, left, house = u(0, self.length), rng.choice([-1, 1]) * u(12, 75), rng.random() < 0.3
            if house:
                self.put(s, left, u(4, 12), u(4, 8), 0, u(4, 12), u(0.2, 0.4), twist=rng.normal() * 0.3)
            elif rng.random() < 0.4:
                self.tree(s, left)
            else:  # a thicket, the edge of a wood
                self.put(s, left, u(1, 8), u(1, 4), 0, u(1, 8), u(0.2, 0.45), fuzz=u(1, 4), twist=rng.normal() * 0.5)


def _roadside(rng, at, length, odds):
    """Everything that stands along a road of `length` m -> (n,10) prisms; what would stand on the road is taken away again."""
    zones = rng.choice(3, p=np.array(odds) / sum(odds), size=(2, int(length / 70) + 1))
    left, right = (_Street(rng, at, length, side, edge, zones[(side + 1) // 2]) for side, edge in ((1, 1.5 * LANE), (-1, 0.5 * LANE)))
    for street in left, right:
        street.plots()
        street.parked_cars()
        street.pavement()
    right.distance()
    out = np.concatenate(left.out + right.out)
    lanes = np.concatenate([np.stack(at(np.arange(0, length, 1.0), left)[:2]) for left in (0, LANE)], axis=1)  # (2,m)
    x, y, yaw, half_x, half_y = out[:, [X, Y, YAW, HALF_X, HALF_Y]].T[:, :, None]  # (n,1) each
    dx, dy, c, s = lanes[0] - x, lanes[1] - y, np.cos(yaw), np.sin(yaw)
    gap = np.hypot(np.maximum(np.abs(c * dx + s * dy) - half_x, 0), np.maximum(np.abs(c * dy - s * dx) - half_y, 0))  # (n,m) [m]
    return out[(gap.min(axis=1) > 1.7) | (out[:, Z0] > 2.2)]  # crowns may reach over the road


def _ground(rng, at, length):
    """A raster of the ground: height [m] and albedo of every CELL, and the corner (2,) it starts at. Road, kerb, pavement, rough grass."""
    x, y, _ = at(np.arange(0, length, CELL / 2), LANE / 2)
    corner = np.array([x.min(), y.min()]) - CITY_RANGE - 5
    i, j = ((np.stack([x, y]) - corner[:, None]) / CELL).astype(int)
    off = np.ones((i.max() + int(90 / CELL), j.max() + int(90 / CELL)), bool)
    off[i, j] = False
    away = distance_transform_edt(off).astype(np.float32) * CELL  # m from the middle of the road
    noise = gaussian_filter(rng.standard_normal(off.shape, dtype=np.float32), 8) * 28  # about N(0,1), 4 m wide
    paved, grass = away > LANE, np.clip((away - LANE - 2.5) / 6, 0, 1)
    height = 0.12 * paved + grass * np.clip(0.15 + 0.2 * noise, 0, 0.6)
    return height.astype(np.float32), (0.33 + 0.03 * paved + 0.03 * noise - 0.04 * grass).astype(np.float32), corner


@functools.lru_cache(maxsize=1)
def _world(name, seed, scans):
    """Everything about one sequence but the sensor: T_wt (scans,4,4) and the same before the hills, prisms (n,10), moving(i) -> prisms of
    scan i, the ground, the hills."""
    style = STYLES.get(name, STYLES["00"])
    rng = np.random.default_rng([seed, zlib.crc32(name.encode())])  # of the name, so that a subset of sequences gives the same files
    t = np.arange(scans + 1) * 0.1
    for _ in range(1000):  # draw again until it is fast and winding enough: 100 m segments, and rotation to get wrong in them
        at, s_of, length = _drive(rng, scans, style)
        s = s_of(t)
        turn = np.degrees(np.diff(at(s)[2]))
        (x, y, yaw), (x1, y1, _) = (at(s[s <= max(s[-1] - 100, s[0])] + ahead) for ahead in (0, 100))
        astray = np.hypot(x + 100 * np.cos(yaw) - x1, y + 100 * np.sin(yaw) - y1).mean()  # m, how far off 100 m would end without turning
        if scans < 100 or s[-1] - s[0] > 0.72 * scans and 0.9 < turn.std() < 1.45 and min(turn.max(), -turn.min()) > 0.5 and astray > 45:
            break
    T, length = _ego(rng, at, s_of, scans), min(length, s_of(t[-1]) + 120)
    prisms = _roadside(rng, at, length, style[3])
    n, t = 2 + int(length / 45), t[:-1]  # cars: one before us, one behind us, the rest comes towards us
    looks, left = _looks(rng, n), np.where(np.arange(n) < 2, 0, LANE)
    s = np.concatenate([[s_of(t + rng.uniform(1.6, 3)), s_of(t - rng.uniform(1.6, 3))],
                        rng.uniform(60, length + 80, (n - 2, 1)) - rng.uniform(6, 12, (n - 2, 1)) * t])  # (n,scans)
    here = (s > 0) & (s < length)

    def moving(i):
        k = here[:, i]
        return _cars(*at(s[k, i], left[k]), looks[:, k])
    ground, (hills, T_hills) = _ground(rng, at, length), _hills(rng, T)
    return T_hills, T, prisms, moving, ground, hills


class _Rays:
    """The rays of a scan, numbered by beam, the top one first, and by azimuth *in the world*, so that a column of rays is one line in plan.

    Roll and pitch are exact: they change the elevation, in the world, of the ray that has the beam's elevation in the sensor frame and the
    column's azimuth in the world's. With n the sensor's up in the world, sin e = n . ray = gain sin(w + tilt)."""

    def __init__(self, R, azimuth, rng):
        self.step = 2 * np.pi / azimuth  # rad, from a column to the next
        self.a0 = np.arctan2(R[1, 0], R[0, 0]) + self.step * rng.random()  # rad, azimuth of the first column
        a = self.a0 + self.step * np.arange(azimuth)
        along = R[0, 2] * np.cos(a) + R[1, 2] * np.sin(a)
        columns = np.cos(a), np.sin(a), np.arctan2(along, R[2, 2]), np.hypot(along, R[2, 2])
        self.cos_a, self.sin_a, self.tilt, self.gain = (v.astype(np.float32) for v in columns)  # (A,) each
        w = np.arcsin(np.sin(ELEVATION[::-1]).astype(np.float32)[:, None] / self.gain) - self.tilt  # (64,A) elevation in the world
        self.top = np.tan(w[0])  # (A,) slope of the highest beam
        self.sin_w, self.cos_w = np.sin(w).ravel(), np.cos(w).ravel()
        self.slope = self.sin_w / self.cos_w  # (64 A,) as the two before


def _count_from(first, count):
    """first[i], first[i] + 1, ..., `count[i]` numbers for each i -> their i and the numbers, (sum of the counts,) each."""
    i = np.repeat(np.arange(len(count)), count)
    return i, np.arange(len(i)) + np.repeat(first - np.cumsum(count) + count, count)


def _cut(p, eye, rays):
    """Every pair (prism, column of rays that may meet it) of p (n,10): prism, column, where the column's line enters and leaves the prism
    in plan [m], and how squarely, each (P,). A box is two slabs, a cylinder a circle."""
    dx, dy, c, s = p[:, X] - eye[0], p[:, Y] - eye[1], np.cos(p[:, YAW]), np.sin(p[:, YAW])
    ox, oy = -(c * dx + s * dy), s * dx - c * dy  # the eye in the prism's frame
    sx, sy = np.array([[1, 1, -1, -1], [1, -1, 1, -1]])[:, None] * p[:, [HALF_X, HALF_Y]].T[:, :, None]  # (n,4) corners
    centre = np.arctan2(dy, dx)
    wide = np.arctan2(dy[:, None] + s[:, None] * sx + c[:, None] * sy, dx[:, None] + c[:, None] * sx - s[:, None] * sy) - centre[:, None]
    wide = (wide + np.pi) % (2 * np.pi) - np.pi  # of a cylinder, these are the corners of the box around it
    first = np.ceil((centre + wide.min(axis=1) - rays.a0) / rays.step).astype(int)
    last = np.floor((centre + wide.max(axis=1) - rays.a0) / rays.step).astype(int)
    inside = (np.abs(ox) < p[:, HALF_X] + 0.3) & (np.abs(oy) < p[:, HALF_Y] + 0.3)
    k, col = _count_from(first, np.where(inside, 0, last - first + 1))
    col %= len(rays.cos_a)
    of_prism = np.stack([c, s, ox, oy, p[:, HALF_X], p[:, HALF_Y], dx, dy, p[:, ROUND]])
    c, s, ox, oy, hx, hy, dx, dy, disc = of_prism.astype(np.float32)[:, k]
    ca, sa, disc = rays.cos_a[col], rays.sin_a[col], disc > 0
    with np.errstate(divide="ignore", invalid="ignore"):
        ux, uy = 1 / (c * ca + s * sa), 1 / (c * sa - s * ca)
        mx, my, rx, ry = -ox * ux, -oy * uy, hx * np.abs(ux), hy * np.abs(uy)
        middle, chord = dx * ca + dy * sa, np.sqrt(np.maximum(hx * hx - (dx * sa - dy * ca) ** 2, 0))
        enter = np.where(disc, middle - chord, np.maximum(mx - rx, my - ry))
        leave = np.where(disc, middle + chord, np.minimum(mx + rx, my + ry))
        return k, col, enter, leave, np.where(disc, chord / hx, 1 / np.where(mx - rx > my - ry, np.abs(ux), np.abs(uy)))


def _meet_prisms(p, eye, rays, rng):
    """What each ray meets first among the prisms: (4,64 A) distance in plan (inf: nothing), cosine of incidence, albedo, fuzz."""
    f4, h = np.float32, np.float32(eye[2])
    p = p[np.hypot(p[:, X] - eye[0], p[:, Y] - eye[1]) - np.hypot(p[:, HALF_X], p[:, HALF_Y]) < CITY_RANGE]
    k, col, enter, leave, facing = _cut(p, eye, rays)
    z0, z1, fuzz = np.stack([p[:, Z0] - h, p[:, Z1] - h, p[:, FUZZ]]).astype(f4)[:, k]
    met = (enter < leave) & (enter > 0.5)
    # nothing is seen behind a prism that stops every beam of its column
    full = met & (z0 <= 0.01 - h) & (z1 > enter * rays.top[col]) & (fuzz == 0)
    wall = np.full(len(rays.cos_a), CITY_RANGE, f4)
    np.minimum.at(wall, col[full], enter[full])
    seen = met & (enter <= wall[col])
    k, col, enter, leave, facing, z0, z1, fuzz = (v[seen] for v in (k, col, enter, leave, facing, z0, z1, fuzz))
    # its candidate beams lie between its lowest and its highest visible edge; seen from above, the highest is the far edge of the roof
    beam_of = lambda m: np.searchsorted(ELEVATION, np.arcsin(np.clip(rays.gain[col] * np.sin(np.arctan(m) + rays.tilt[col]), -1, 1)))
    low, high = beam_of(z0 / np.where(z0 > 0, leave, enter)), beam_of(z1 / np.where(z1 > 0, enter, leave))
    g, beam = _count_from(low, np.maximum(high - low, 0))  # the pair and the beam of every candidate
    ray = (63 - beam) * len(rays.cos_a) + col[g]
    stops = (fuzz == 0)[g] | (rng.random(len(g), dtype=f4) > 0.3)  # light passes through foliage here and there
    g, ray = g[stops], ray[stops]
    m = rays.slope[ray]
    z = m * enter[g]
    above, below = z > z1[g] + 1e-3, z < z0[g] - 1e-3
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = np.where(above | below, np.where(above, z1[g], z0[g]) / m, enter[g])  # its top or its underside, if not its face
    d, cosine, shade, blur = out = np.zeros((4, len(rays.slope)), f4)
    d[:] = np.inf
    np.minimum.at(d, ray, reach)
    best = reach <= d[ray]
    hit, g, flat = ray[best], g[best], (above | below)[best]
    cosine[hit] = np.where(flat, np.abs(rays.sin_w[hit]), facing[g] * rays.cos_w[hit])
    shade[hit], blur[hit] = p[k, ALBEDO].astype(f4)[g], np.where(fuzz > 0, fuzz, RELIEF * (z1 - z0 > 3))[g]
    return out


def _meet_ground(met, ground, eye, rays):
    """Fills in, where `met` of `_meet_prisms` holds nothing, what the ray meets on the ground, unless our own car is in its way."""
    d, cosine, shade, _ = met
    height, albedo, corner = ground
    f4, h, azimuth = np.float32, np.float32(eye[2]), len(rays.cos_a)
    aside = np.abs((rays.step * np.arange(azimuth) + np.pi) % (2 * np.pi) - np.pi)  # the lowest beams meet our own bonnet and boot
    own_car = np.where(aside < 0.4, 6, np.where(aside > 2.55, 13, 0)) > np.arange(63, -1, -1)[:, None]
    low = np.flatnonzero((d == np.inf) & (rays.slope < -h / f4(CITY_RANGE)) & ~own_car.ravel())
    m, col = rays.slope[low], low % azimuth
    flat = -h / m
    for _ in range(2):  # where it meets the plane, then where it meets the ground found there
        cell = tuple(((e + flat * v[col]) / CELL).astype(np.int32) for e, v in zip((eye[:2] - corner).astype(f4), (rays.cos_a, rays.sin_a)))
        flat = (height[cell] - h) / m
    d[low], cosine[low], shade[low] = flat, -rays.sin_w[low], albedo[cell]


def _simulate_scan(name, seed, scans, azimuth, i):
    """Scan i of a sequence -> (N,4) float32, beam by beam from the top.

    What makes it cheap: a column of rays is one line in plan, so a prism is cut once per column, and which beams it stops follows from
    two heights."""
    T, flat, prisms, moving, ground, hills = _world(name, seed, scans)
    rng = np.random.default_rng([seed, zlib.crc32(name.encode()), i])  # of the scan, so that it does not matter who makes it
    R, eye, f4 = T[i, :3, :3], flat[i, :3, 3], np.float32
    rays = _Rays(flat[i, :3, :3], azimuth, rng)
    met = _meet_prisms(np.concatenate([prisms, moving(i)]), eye, rays, rng)
    _meet_ground(met, ground, eye, rays)
    # returns: noise, drop-outs, intensity
    ray = np.flatnonzero(met[0] < CITY_RANGE)
    d, cosine, shade, blur = met[:, ray]
    noise = lambda: rng.standard_normal(len(ray), dtype=f4)
    col = ray % azimuth
    ways = rays.cos_a[col], rays.sin_a[col], rays.slope[ray]  # for each metre in plan
    a, b, c = (np.floor((start + d * way) / 0.6).astype(np.int64) for start, way in zip(eye, ways))  # in cells of 0.6 m of the world
    # how deep light gets there into foliage, or into the windows and doors of a facade: 0 to 1, the same in every scan
    rough = ((a * 73856093 ^ b * 19349663 ^ c * 83492791) % 1009).astype(f4) / 1009
    r = d / rays.cos_w[ray] + 0.02 * noise() + blur * (0.8 * rough + 0.2 * rng.random(len(ray), dtype=f4))
    lost = 0.01 + 0.10 * (r / 40) ** 2 * (0.15 / (0.05 + shade)) + 0.3 * np.exp(-cosine / 0.02) + 0.5 * np.exp(-shade / 0.03)
    light = shade * (0.65 + 0.4 * np.sqrt(cosine)) + 0.08 * noise() - 0.01 * np.maximum(r - 25, 0)  # from 60 m on KITTI's are mostly 0
    light *= rng.random(len(ray), dtype=f4) > 0.08
    back = (rng.random(len(ray), dtype=f4) > lost) & (r < CITY_RANGE) & (r > MIN_RANGE)
    ray, col, r, light = ray[back], col[back], r[back], light[back]
    d = r * rays.cos_w[ray]
    x, y, z = d * rays.cos_a[col], d * rays.sin_a[col], r * rays.sin_w[ray]  # from the eye, axes of the world
    z += (hills(x + f4(eye[0]), y + f4(eye[1])) - hills(*eye[:2])).astype(f4)  # what a crest would hide is still seen
    # R^T turns them into the sensor's; no BLAS, whose sums depend on its threads
    x, y, z = (x * q[0] + y * q[1] + z * q[2] for q in R.T.astype(f4))
    return np.stack([x, y, z, np.round(np.clip(light, 0, 0.99), 2)], axis=1)  # (N,4)


def _save_scan(task):
    path, name, settings, i = task
    _simulate_scan(name, settings["seed"], settings["scans"], settings["azimuth"], i).tofile(path)


def _calibration():
    """Tr (4,4) and the text of calib.txt, of a camera that looks along x as KITTI's does: axes permuted, a fraction of a degree off, 8 cm
    lower and 27 cm further ahead."""
    Tr = np.eye(4)
    Tr[:3, :3] = Rotation.from_euler("xyz", [0.4, -0.5, 0.3], degrees=True).as_matrix() @ [[0, -1, 0], [0, 0, -1], [1, 0, 0]]
    Tr[:3, 3] = [-0.012, -0.076, -0.272]
    P = [np.array([[718.856, 0, 607.193, x], [0, 718.856, 185.216, 0], [0, 0, 1, 0]]) for x in (0, -386.1, 45.4, -337.3)]
    calib = "".join(f"{k}: {' '.join(f'{x:.12e}' for x in m.ravel())}\n" for k, m in zip(("P0", "P1", "P2", "P3", "Tr"), (*P, Tr[:3])))
    return Tr, calib


def _missing(root, names, seed, scans, azimuth):
    """Sequence -> its settings, of those that are not in ROOT yet. ValueError for what is there from elsewhere or with other settings."""
    jobs = {}
    for name in names:
        if not isinstance(name, str) or name in ("", ".", "..") or re.search(r"[/\\\0]", name):
            raise ValueError(f"The sequence name {name!r} is no plain folder name: use one such as '00'.")
        enough = 170 if name in SPLITS["test"] + SPLITS["validation"] else 320  # for 100 m segments, few enough to make on the spot
        settings = {"city": CITY, "seed": int(seed), "scans": int(scans or enough), "azimuth": int(azimuth)}
        folder, truth = root / "sequences" / name, root / "poses" / f"{name}.txt"
        made = folder / "simulated.json"
        if folder.exists() or truth.exists():  # another process may make it at any moment, so only now see what it is
            found = made.read_text() if made.exists() else "not simulated"
            if found != json.dumps(settings):
                raise ValueError(f"{folder} or {truth} is there already, {found} and not {json.dumps(settings)}: choose another folder.")
        if not (folder.exists() and truth.exists()):
            jobs[name] = settings
    return jobs


def simulate(root: str | Path, seed=0, sequences=tuple(f"{i:02d}" for i in range(11)), scans=None, azimuth=1800, workers=None) -> Path:
    """Drives an HDL-64E through one simulated city per sequence and writes ROOT in KITTI's odometry layout with exact ground truth -> ROOT.

    sequences: names, splits or 'all'; scans: number per sequence (None: 170 for test and validation, which drive more than 115 m, else 320);
    azimuth: rays per beam and turn; workers: processes (None: one per core). The same arguments give the same bytes, whatever else is made
    along. A sequence appears when it is complete; one that is there already, made with the same settings, is left as it is.
    Raises ValueError for arguments out of range, or when ROOT holds such a sequence from elsewhere or of other settings."""
    root = Path(root)
    for what, value, least in (("seed", seed, 0), ("scans", scans, 1), ("azimuth", azimuth, 16), ("workers", workers, 1)):
        if value is not None and (value != int(value) or value < least):
            raise ValueError(f"{what} is {value} but must be a whole number, {least} or more.")
    names = [sequences] if isinstance(sequences, str) else sequences
    names = dict.fromkeys(m for n in names for m in (sum(SPLITS.values(), ()) if n == "all" else SPLITS.get(n, (n,))))
    jobs = _missing(root, names, seed, scans, azimuth)
    Tr, calib = _calibration()
    # one name per process: two of them may fill the same ROOT, and whoever finishes a sequence first has made it
    temporary = {n: temporary_beside(root / "sequences" / n) for n in jobs if not (root / "sequences" / n).exists()}
    tasks = [(folder / "velodyne" / f"{i:06d}.bin", n, jobs[n], i) for n, folder in temporary.items() for i in range(jobs[n]["scans"])]
    in_pool = (workers or cores()) > 1 and len(tasks) > 8
    saved = in_processes(_save_scan, tasks, workers, chunksize=8) if in_pool else map(_save_scan, tasks)
    try:
        for folder in temporary.values():
            shutil.rmtree(folder, ignore_errors=True)  # of an earlier process of the same number
            (folder / "velodyne").mkdir(parents=True)
        made = progress(saved, len(tasks), "simulating")
        for name, settings in jobs.items():
            T, folder = _world(name, settings["seed"], settings["scans"])[0], root / "sequences" / name
            if name in temporary:
                for _ in range(len(T)):
                    next(made)
                (temporary[name] / "calib.txt").write_text(calib)
                (temporary[name] / "times.txt").write_text("".join(f"{0.1 * i:.6e}\n" for i in range(len(T))))
                (temporary[name] / "simulated.json").write_text(json.dumps(settings))
                try:
                    temporary[name].rename(folder)
                except OSError:  # another process was faster, or it cannot be
                    if not (folder / "simulated.json").exists():
                        raise
            if (folder / "simulated.json").read_text() != json.dumps(settings):
                raise ValueError(f"{folder} was made meanwhile, with other settings: choose another folder.")
            write_poses(root / "poses" / f"{name}.txt", velo_to_camera(invert(T[0]) @ T, Tr))  # last: without it a sequence is not complete
        next(made, None)  # lets the progress line end
    finally:
        if in_pool:
            saved.close()
        for folder in temporary.values():
            shutil.rmtree(folder, ignore_errors=True)
    return root


def main(argv=None):
    """The command line -> exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True, metavar="simulate | raw")
    s = commands.add_parser("simulate", help="make simulated drives, with ground truth")
    s.add_argument("dir", metavar="DIR", help="where to")
    s.add_argument("--seed", type=int, metavar="N", default=0, help="another seed, other cities (default: 0)")
    s.add_argument("--sequences", nargs="+", metavar="NN", default=["all"], help="names, or train, test, validation, all (default)")
    s.add_argument("--scans", type=int, metavar="N", help="scans per sequence (default: 170 for test and validation, else 320)")
    s.add_argument("--azimuth", type=int, metavar="N", default=1800, help="rays per beam and turn (default: 1800)")
    r = commands.add_parser("raw", help="convert a drive of KITTI's raw data, with ground truth")
    r.add_argument("drive", metavar="DRIVE",
                   help="unpacked folder such as 2011_09_26/2011_09_26_drive_0013_sync")
    r.add_argument("dir", metavar="ROOT", help="where to, in KITTI's odometry layout")
    args = parser.parse_args(argv)
    terminate_as_interrupted()
    try:
        if args.command == "raw":
            parts = convert_raw(args.drive, args.dir)
            made = open_sequences(args.dir, list(parts))
        else:
            simulate(args.dir, args.seed, args.sequences, args.scans, args.azimuth)
            made = open_sequences(args.dir, args.sequences)
    except (ValueError, OSError) as error:
        print(f"kitti.py: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("kitti.py: interrupted; sequences that are complete stay, run the same command again for the rest.", file=sys.stderr)
        return 130
    print(f"{args.dir}: {len(made)} sequences, {sum(map(len, made)):,} scans")
    if args.command == "raw":
        for s, (first, last) in zip(made, parts.values()):
            print(f"{s.name}: scans {first} to {last}, {path_lengths(s.poses)[-1]:.1f} m")
        if len(made) > 1:
            print("The drive is split where scans or their GPS/IMU packets are missing.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
