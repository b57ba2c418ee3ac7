"""The data: KITTI odometry scans, calibration, frames, splits, ground plane, simulated city.

A scan is an array (N,4) float32: x, y, z [m] in the Velodyne frame (x forward, y left, z up) and
intensity [0..1]. `T_ab` maps points from frame b to frame a. KITTI's pose files are in the frame of
the rectified left camera; `poses` and `motions()` of a sequence are in the Velodyne frame, as the
points are: T_velo = inv(Tr) @ T_cam @ Tr.

The simulated city can be used in place of KITTI: a car with an HDL-64E drives through 11 small
cities, one for each sequence, with exact ground truth: 2,620 scans, 4.2 GB.

    python kitti.py simulate data/city
    python kitti.py simulate data/tiny --sequences 00 07 --scans 40 --azimuth 900
    python kitti.py raw DRIVE data/raw      # convert a drive of KITTI's raw data
"""
import argparse
import ctypes
import errno
import functools
import hashlib
import importlib.metadata
import json
import multiprocessing
import os
import platform
import re
import secrets
import shutil
import signal
import subprocess
import sys
import threading
import time
import warnings
import zlib
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor
from contextlib import ExitStack, closing, contextmanager, suppress
from decimal import Decimal
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.ndimage import distance_transform_edt, gaussian_filter
from scipy.spatial.transform import Rotation

from metrics import (
    is_rigid,
    parse,
    path_lengths,
    read_lines,
    read_poses,
    replacing,
    run_command,
    step_errors,
    write_poses,
)

# Section 4 of the paper
SPLITS = {
    "train": ("00", "01", "02", "08", "09"),
    "test": ("03", "04", "05", "06", "10"),
    "validation": ("07",),
}

# ------------------------------------------------------------------------------------------------
# Frames


def rigid(R, t):
    """Rotations (...,3,3) and translations (...,3) -> rigid transforms (...,4,4) float64."""
    T = np.zeros((*R.shape[:-2], 4, 4))
    T[..., :3, :3] = R
    T[..., :3, 3] = t
    T[..., 3, 3] = 1
    return T


def invert(T):
    """The inverses of rigid transforms (...,4,4): R^T and -R^T t for R and t.

    Faster and more accurate than a general matrix inverse.
    """
    T = np.asarray(T, dtype=float)
    R_inverse = np.swapaxes(T[..., :3, :3], -1, -2)
    return rigid(R_inverse, (-R_inverse @ T[..., :3, 3:])[..., 0])


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
    with warnings.catch_warnings():
        # At a pitch of +-90 degrees (gimbal lock), scipy warns and sets the third angle to zero.
        # The rotation is still the same.
        warnings.simplefilter("ignore", UserWarning)
        angles = Rotation.from_matrix(flat[:, :3, :3]).as_euler("xyz", degrees=True)
    return np.concatenate([flat[:, :3, 3], angles], axis=1).reshape(*T.shape[:-2], 6)


def from_vector(v: np.ndarray) -> np.ndarray:
    """The inverse of `to_vector`: (...,6) in metres and degrees -> (...,4,4) float64."""
    v = np.asarray(v, dtype=float)
    R = Rotation.from_euler("xyz", v[..., 3:].reshape(-1, 3), degrees=True).as_matrix()
    return rigid(R.reshape(*v.shape[:-1], 3, 3), v[..., :3])


# ------------------------------------------------------------------------------------------------
# Scans, calibration and sequences

OTHER_FORMATS = b"\x93NUMPY", b"ply\n", b"ply\r", b"# .PCD"  # how files of other formats begin
OTHER_SUFFIXES = ".pcd", ".ply", ".las", ".bag", ".mcap", ".db3"
OTHER_COLUMNS = {  # what else a .bin file may hold: NumPy type, number of columns
    "five floats per point, as in nuScenes": ("float32", 5), "float64": ("float64", 4),
    "six floats per point": ("float32", 6), "eight floats per point": ("float32", 8)}


def _check_size(path, size=None):
    """Raise ValueError unless a .bin file can hold a scan, by its size in bytes."""
    size = path.stat().st_size if size is None else size
    if size == 0 or size % 16:
        raise ValueError(f"{path} has {size} bytes, but a scan has 16 (four float32) per point: "
                         "if it is truncated, copy or unpack it again; if it has other columns, "
                         "five floats per point as in nuScenes for example, convert it with "
                         "np.save(NEW, np.fromfile(OLD, 'float32').reshape(-1, 5)[:, :4]).")


def _is_scan(points, intensity_max=255):
    """Whether the columns of points (N,4+) look like x, y, z [m] and an intensity up to a maximum.

    One point in a hundred may be anything.
    """
    with np.errstate(invalid="ignore"):  # NaN does not count against a scan
        odd = ((np.abs(points[:, :3]) > 1e5).any(1)
               | (points[:, 3] > intensity_max) | (points[:, 3] < -0.01))
    return np.count_nonzero(odd) <= len(points) / 100


def read_scan(path: str | Path, intensity_max: float = 1) -> np.ndarray:
    """Read one scan, a .bin or .npy file.

    Returns (N,4) float32: x, y, z [m] in the LiDAR's frame, and the intensity divided by
    `intensity_max` and clipped to 0..1. NaN is kept. A .bin file holds four float32 per point, like
    KITTI's. A .npy file holds an array (N,3) or (N,4); without a fourth column the intensities are
    0. Raises OSError if the file cannot be read, and ValueError if it is empty, damaged or of
    another format, with what it looks like, or if `intensity_max` is not positive.
    """
    if not 0 < intensity_max < np.inf:
        raise ValueError(f"intensity_max is {intensity_max}, but must be a positive number")
    path = Path(path)
    if path.suffix == ".npy":
        points, data = _read_npy(path), b""
    else:
        data = path.read_bytes()
        if data.startswith(OTHER_FORMATS):
            raise ValueError(f"{path} is not a KITTI scan but a file of another format: read it "
                             "with its own library and save x, y, z, intensity as .npy.")
        _check_size(path, len(data))
        points = np.frombuffer(data, "<f4").reshape(-1, 4)
    scan = np.zeros((len(points), 4), np.float32)
    with np.errstate(over="ignore"):  # numbers too large for float32 become infinite
        scan[:, :points.shape[1]] = points
    if not _is_scan(scan, max(255, intensity_max)):
        advice = "save these columns as float32, and intensities divided by their maximum"
        for kind, (dtype, columns) in OTHER_COLUMNS.items():
            numbers = np.frombuffer(data, dtype)
            if len(data) and len(numbers) % columns == 0 and _is_scan(numbers.reshape(-1, columns)):
                advice = (f"it looks like {kind}; convert it with np.save(NEW, np.fromfile(OLD, "
                          f"'{dtype}').reshape(-1, {columns})[:, :4])")
                break
        raise ValueError(f"{path} does not hold x, y, z [m] and intensities of 0 to 1 or 0 to 255: "
                         f"{advice}.")
    scan[:, 3] = np.clip(scan[:, 3] / intensity_max, 0, 1)
    return scan


def _read_npy(path):
    """The array (N,3) or (N,4) of a .npy file."""
    try:
        points = np.load(path, allow_pickle=False)
        shape, dtype = points.shape, points.dtype
    except OSError:
        raise
    except Exception:  # np.load raises many exception types; all of them mean a corrupt file
        raise ValueError(f"{path} is damaged or not a NumPy file: save the scan again.") from None
    if len(shape) != 2 or shape[0] == 0 or shape[1] not in (3, 4) or dtype.kind not in "fiu":
        raise ValueError(f"{path} has shape {shape} of {dtype}, but a scan is an array of numbers "
                         "(N,3) or (N,4): save the columns x, y, z and intensity.")
    return points


def scans_in(folder):
    """The *.bin and *.npy files of a folder in their order: list of paths, without hidden files.

    Names that are all one number, such as times, are sorted by value, 0.9 before 0.95. All others
    are in natural order, 2 before 10.
    """
    paths = [path for path in Path(folder).glob("[!.]*") if path.suffix in (".bin", ".npy")]
    if all(re.fullmatch(r"\d+(\.\d+)?", path.stem) for path in paths):
        return sorted(paths, key=lambda path: (Decimal(path.stem), path.name))
    return sorted(paths, key=lambda path: re.sub(r"\d+", lambda n: n[0].zfill(20), path.name))


def read_calib(path: str | Path) -> np.ndarray:
    """Read the row `Tr` of a sequence's calib.txt.

    Returns T_cam0_velo (4,4) float64, which maps points from the Velodyne frame to the frame of the
    rectified left camera [m]. Raises FileNotFoundError if there is no such file, and ValueError if
    `Tr` is missing or is not a finite rigid transform of 12 numbers.
    """
    remedy = ("KITTI's is in data_odometry_calib.zip; for drives of your own write the line "
              "Tr: 0 -1 0 0 0 0 -1 0 1 0 0 0")
    if not Path(path).is_file():
        raise FileNotFoundError(f"{path} does not exist: {remedy}.")
    row = _calib_row(path, "Tr", 12).reshape(3, 4)
    if not is_rigid(row):
        raise ValueError(f"{path} has no row 'Tr' (Velodyne to camera) of 12 finite numbers, a "
                         f"rotation and a translation: {remedy}.")
    return np.vstack([row, [0, 0, 0, 1]])  # (4,4)


def _calib_row(path, name, count):
    """The numbers (count,) of row `name` in a calibration file, NaN if there is no such row."""
    rows = [words[1:] for _, words in read_lines(path) if words[0] == f"{name}:"]
    return parse(rows[0] if rows else [], count)


def write_tum(path: str | Path, T: np.ndarray, times: np.ndarray) -> None:
    """Write poses (n,4,4) at `times` (n,) [s] as a TUM trajectory file, through a temporary file.

    A row is t x y z qx qy qz qw, with qw >= 0, in the frame of the poses. Raises ValueError if the
    numbers of poses and times differ, and OSError if the file cannot be written.
    """
    q = Rotation.from_matrix(T[:, :3, :3]).as_quat(canonical=True)  # (n,4)
    with replacing(path) as temporary, open(temporary, "w", newline="\n") as file:
        np.savetxt(file, np.c_[times, T[:, :3, 3], q], fmt="%.9f")


class Sequence:
    """The scans of a drive, with ground truth where there is some. Checks its files when opened.

    folder: ROOT/sequences/NAME of KITTI's layout, with velodyne/000000.bin ... and calib.txt, or
        a plain folder of scans, *.bin or *.npy.
    truth: in KITTI's layout, the path of the ground truth, ROOT/poses/NAME.txt, which need not
        exist. None: a plain folder.

    name, folder; scan_paths: list of n paths; intensity_max: intensities are divided by it;
    Tr (4,4): T_cam0_velo; poses_cam (n,4,4): the poses as in the file; poses (n,4,4): T_0t in the
    Velodyne frame. The last three are None where there are none. times (n,) [s], of a plain folder;
    notes: list of lines, one for each assumption made. Raises FileNotFoundError for a missing file,
    and ValueError for a damaged one or if the files do not fit together.
    """

    def __init__(self, folder, truth=None):
        self.folder, self.name = Path(folder), Path(os.path.abspath(folder)).name
        self.scan_paths = scans_in(self.folder / "velodyne" if truth else folder)
        if not self.scan_paths:
            raise FileNotFoundError(f"{folder} holds no scans, *.bin or *.npy; KITTI's are in "
                                    "data_odometry_velodyne.zip.")
        self.Tr = self.poses_cam = self.poses = None
        self.intensity_max, self.notes = 1, []
        if truth:
            self._open_kitti(Path(truth))
        else:
            self._open_folder()

    def _open_kitti(self, truth):
        """Check the scans; read calib.txt and, if it exists, the ground truth."""
        for i, path in enumerate(self.scan_paths):
            if path.name != f"{i:06d}.bin":
                raise ValueError(f"{path.parent} should hold {i:06d}.bin next but holds "
                                 f"{path.name}: scans are numbered from 000000 without a gap; "
                                 "unpack data_odometry_velodyne.zip again.")
            _check_size(path)
        self._scale_intensities()
        self.Tr = read_calib(self.folder / "calib.txt")
        if not truth.exists():
            return
        self.poses_cam = read_poses(truth)  # (n,4,4)
        if len(self.poses_cam) != len(self):
            raise ValueError(f"{truth} has {len(self.poses_cam)} poses but {self.folder} has "
                             f"{len(self)} scans: the numbers must agree; unpack the incomplete "
                             "archive again.")
        self.poses = camera_to_velo(self.poses_cam, self.Tr)  # (n,4,4)
        metres, degrees = step_errors(np.tile(np.eye(4), (len(self), 1, 1)), self.poses).T
        for i in np.flatnonzero((metres > 10) | (degrees > 45))[:1]:
            self.notes.append(f"{truth}, from line {i + 1} to {i + 2}: a step of {metres[i]:.1f} m "
                              f"and {degrees[i]:.0f} deg; if it is wrong, correct the file")

    def _open_folder(self):
        """Check the scans; set intensity_max and times, and note what was assumed."""
        if len({path.suffix for path in self.scan_paths}) > 1:
            raise ValueError(f"{self.folder} holds both .bin and .npy files: move one kind "
                             "elsewhere.")
        for path in self.scan_paths:
            if path.suffix == ".bin":
                _check_size(path)

        numbers = [re.findall(r"\d+(?:\.\d+)?", path.stem) for path in self.scan_paths]
        for column in zip(*numbers):  # the first numbers in the names, the second ...
            self._note_gaps(np.array(column, float), "file names")
        self._scale_intensities()
        if (self.folder / "times.txt").exists():
            self.times = self._read_times(self.folder / "times.txt")
            self._note_gaps(self.times, "times.txt")
        else:
            self.times = 0.1 * np.arange(len(self))
            self.notes.append("no times.txt among the scans (one time in seconds per line); "
                              "10 scans a second are assumed")

    def _note_gaps(self, numbers, source):
        """Note steps of increasing numbers (n,) that are above 1.5 times the median step."""
        steps = np.diff(numbers)
        if len(steps) > 1 and (steps > 0).all() and (gaps := steps > 1.5 * np.median(steps)).any():
            missing = (np.round(steps[gaps] / np.median(steps)) - 1).clip(1).sum()
            self.notes.append(f"{missing:.0f} scans are missing by the {source}, the first after "
                              f"{self.scan_paths[gaps.argmax()].name}; the motion across a gap may "
                              "be wrong")

    def _scale_intensities(self):
        """Set intensity_max to 255 if more than 1 % of the points of ten scans are above 1."""
        chosen = np.unique(np.linspace(0, len(self) - 1, 10).astype(int))
        scans = [read_scan(self.scan_paths[i], 255) for i in chosen]
        intensity = 255 * np.concatenate(scans)[:, 3]
        if np.count_nonzero(intensity > 1.001) > len(intensity) / 100:
            self.intensity_max = 255
            self.notes.append(f"intensities reach {np.nanmax(intensity):.4g}; all are divided by "
                              "255")
        if not (intensity > 0).any():
            self.notes.append("there are no intensities; zeros are used, so expect larger errors")

    def _read_times(self, path):
        """The times (n,) [s] in a times.txt, one per line."""
        times = parse([words[0] for _, words in read_lines(path)], len(self))
        if not (np.isfinite(times).all() and (np.diff(times) > 0).all()):
            raise ValueError(f"{path} must hold {len(self)} increasing numbers, the time of each "
                             "scan in seconds: correct it, or remove it to assume 10 scans a "
                             "second.")
        if len(times) > 1 and np.median(np.diff(times)) > 60:
            raise ValueError(f"{path} has steps of {np.median(np.diff(times)):.4g}, which cannot "
                             "be seconds: divide nanoseconds by 1e9, for example.")
        return times

    def __len__(self):
        return len(self.scan_paths)

    def scan(self, i: int) -> np.ndarray:
        """Scan i as (N,4) float32, see `read_scan`."""
        return read_scan(self.scan_paths[i], self.intensity_max)

    def motions(self) -> np.ndarray:
        """True motions T_{t,t+1} = inv(T_t) @ T_{t+1} (n-1,4,4), eq. 1 of the paper.

        They are in the Velodyne frame and map points of scan t+1 to the frame of scan t. Raises
        ValueError if the sequence has no ground truth.
        """
        if self.poses is None:
            raise ValueError(f"Sequence {self.name} has no ground truth: put it into ROOT/poses/"
                             f"{self.name}.txt beside ROOT/sequences (SemanticKITTI's sequences/"
                             f"{self.name}/poses.txt is not ground truth: SuMa estimated it).")
        return invert(self.poses[:-1]) @ self.poses[1:]

    def fingerprint(self, scan_crcs):
        """16 hex digits that identify the sequence by its content, in any folder.

        scan_crcs: the CRC-32 of every scan (n,) uint32. The poses are included.
        """
        poses = b"" if self.poses_cam is None else self.poses_cam.tobytes()
        return hashlib.sha256(np.ascontiguousarray(scan_crcs).tobytes() + poses).hexdigest()[:16]


def expand_splits(names):
    """Names of sequences and splits, or one of them -> names of sequences, each once, in order."""
    names = [names] if isinstance(names, str) else names
    groups = SPLITS | {"all": sum(SPLITS.values(), ())}
    return list(dict.fromkeys(member for name in names for member in groups.get(name, (name,))))


def sequence_names(root: str | Path) -> list[str]:
    """The names of the sequences of ROOT that have scans, sorted.

    A plain folder of scans is one sequence with the folder's name. Raises FileNotFoundError if
    there are no scans in a known layout.
    """
    root = Path(root)
    if not (root / "sequences").exists() and scans_in(root):
        return [Path(os.path.abspath(root)).name]
    names = sorted(velodyne.parent.name for velodyne in root.glob("sequences/[!.]*/velodyne")
                   if any(velodyne.glob("[!.]*.bin")))
    if names:
        return names
    if not root.exists():
        raise FileNotFoundError(f"{root}: no such folder; check the path.")
    remedy = "check the path and unpack its archives"
    paths = root, *root.glob("*"), *root.glob("*/*")
    if any(re.search(r"_drive_\d+|^velodyne_points$", path.name) for path in paths):
        remedy = "convert KITTI's raw data with `python kitti.py raw DRIVE ROOT`"
    elif any(path.suffix.lower() in OTHER_SUFFIXES for path in paths):
        remedy = "save every scan as .npy, (N,4): x, y, z, intensity, as in docs/your-data.md"
    elif any(path.name == "velodyne" for path in paths):
        remedy = "give the folder that holds sequences/, or only a folder velodyne"
    elif root.is_file():
        raise FileNotFoundError(f"{root} is a file: give the folder that holds the scans.")
    raise FileNotFoundError(
        f"{root} has no scans in a known layout: {remedy}. Known layouts: a folder of *.bin or "
        "*.npy files, and KITTI's odometry layout, ROOT/sequences/00/{velodyne/000000.bin, "
        "calib.txt} and ROOT/poses/00.txt.")


def open_sequences(root: str | Path, names: str | list[str] = "all") -> list[Sequence]:
    """Open sequences of ROOT, in the order given, each once.

    names: one or several names of folders under ROOT/sequences, splits of SPLITS, or "all".
    Sequences of a split that ROOT lacks are skipped. A ROOT without a folder sequences/ is a plain
    folder of scans, one sequence. Raises ValueError for a name or split with no sequence in ROOT,
    and the errors of `sequence_names` and `Sequence`.
    """
    root, available, chosen = Path(root), sequence_names(root), []
    for name in [names] if isinstance(names, str) else names:
        members = available if name == "all" else expand_splits(name)
        members = [member for member in members if member in available]
        if not members:
            splits = [split for split in SPLITS if set(SPLITS[split]) & set(available)]
            raise ValueError(f"{root} has no sequence or split {name!r} with scans: choose from "
                             f"{' '.join([*splits, 'all', *available])}.")
        chosen += members
    if not (root / "sequences").exists():
        return [Sequence(root) for _ in dict.fromkeys(chosen)]
    return [Sequence(root / "sequences" / name, root / "poses" / f"{name}.txt")
            for name in dict.fromkeys(chosen)]


# ------------------------------------------------------------------------------------------------
# From a scan to a point cloud

MIN_VALID_RANGE, MAX_VALID_RANGE = 0.1, 1000.0  # [m]; many LiDARs store (0, 0, 0) for no return
MAX_VALID_INTENSITY = 65536  # no LiDAR returns more
# Scan statistics, used to warn about domain shift
STATS = ("usable points", "mean intensity", "median range of the centroids [m]",
         "share of points in the densest 0.3 m of height (the ground)")


def usable_points(scan, max_range=None, plane=True):
    """Select the points of a scan that the network uses, and count the invalid ones.

    (N,4) -> (M,4) float32, in the same order, and a number. Invalid points are dropped first: those
    that are not finite, or whose range or intensity is too large for a LiDAR. So are points closer
    than MIN_VALID_RANGE, where the laser saw nothing; they are not counted. Then points beyond
    `max_range` metres are dropped (None: keep all). If `plane` is False, the ground plane is
    removed last. Raises ValueError for anything but an array of numbers (N,4).
    """
    scan = np.asarray(scan)
    if scan.dtype.kind not in "fiu":
        raise ValueError(f"a scan is an array of numbers (N, 4), not of type {scan.dtype}")
    with np.errstate(over="ignore", invalid="ignore"):
        scan = scan.astype(np.float32, copy=False)
        if scan.ndim != 2 or scan.shape[1] != 4:
            raise ValueError(f"a scan has the shape (N, 4), not {scan.shape}; give x, y, z [m] and "
                             "intensity for N points, zeros if there are no intensities")
        x, y, z, intensity = scan.T  # (N,) each
        squared_range = x * x + y * y + z * z
        # A comparison with NaN is false
        valid = (squared_range < MAX_VALID_RANGE**2) & (np.abs(intensity) < MAX_VALID_INTENSITY)
        near = ((squared_range < (max_range or MAX_VALID_RANGE) ** 2)
                & (squared_range >= MIN_VALID_RANGE**2))
    kept = scan[valid & near]  # (M,4)
    return kept if plane else remove_plane(kept), np.count_nonzero(~valid)


def scan_stats(scan, centroids):
    """Usable points (M,4) and the centroids sampled from them (S,3) -> STATS (4,) of the scan."""
    height = np.clip(scan[:, 2], -100, 100)
    layer = np.floor(height / 0.3).astype(int)  # (M,)
    ground_share = np.bincount(layer - layer.min()).max() / len(scan)
    centroid_range = np.linalg.norm(centroids, axis=1)  # (S,)
    mean_intensity = scan[:, 3].mean(dtype=float)
    return np.array([len(scan), mean_intensity, np.median(centroid_range), ground_share])


def domain_shift(stats, seen):
    """Name the statistics of a scan outside the range in training by more than a factor of 1.5.

    stats: STATS (4,); seen (2,4): the smallest and largest values in training. Returns a text,
    empty if there are none.
    """
    return "; ".join(f"{name} {x:.3g} (in training {low:.3g} to {high:.3g})"
                     for name, x, low, high in zip(STATS, stats, *seen)
                     if not low / 1.5 <= x <= high * 1.5)


def remove_plane(scan: np.ndarray, threshold=0.15, max_tilt=15.0, hypotheses=400, subsample=4000,
                 seed=0) -> np.ndarray:
    """Remove the ground plane from a scan by RANSAC, section 4 of the paper.

    (N,3) or more columns -> the points that are `threshold` metres or more away from the dominant
    plane n . x = d whose normal n is within `max_tilt` degrees of vertical. `hypotheses` planes
    through three random points are scored on `subsample` random points. The best is fitted twice
    to all its inliers. Order and non-finite points are kept. The scan is unchanged if no plane
    qualifies.
    """
    xyz = np.ascontiguousarray(scan[:, :3], dtype=np.float32)  # (N,3)
    finite = np.flatnonzero(np.isfinite(xyz).all(axis=1))
    if len(finite) < 3:
        return scan
    rng, min_cosine = np.random.default_rng(seed), np.cos(np.radians(max_tilt))

    def inliers(points, n, d):
        with np.errstate(invalid="ignore", over="ignore"):  # NaN is never an inlier
            return np.abs(points @ n.astype(np.float32) - d.astype(np.float32)) < threshold

    # Hypotheses: planes through three random points
    a, b, c = xyz[finite[rng.integers(len(finite), size=(3, hypotheses))]].astype(float)  # (H,3)
    sample = xyz[finite[rng.integers(len(finite), size=min(subsample, len(finite)))]]  # (M,3)
    normal = np.cross(b - a, c - a)  # (H,3)
    length = np.linalg.norm(normal, axis=1)
    level = np.abs(normal[:, 2]) > min_cosine * np.maximum(length, 1e-9)
    if not level.any():
        return scan
    normal = normal[level] / length[level, None]
    offset = (normal * a[level]).sum(axis=1)  # (H,)

    # Take the one with the most inliers in the sample; fit it to all its inliers
    best = inliers(sample, normal.T, offset).sum(axis=0).argmax()
    n, d = normal[best], offset[best]
    for _ in range(2):
        points = xyz[inliers(xyz, n, d)]
        if len(points) < 3:
            return scan
        mean = points.mean(axis=0, dtype=float)
        centred = points - mean.astype(np.float32)
        _, directions = np.linalg.eigh((centred.T @ centred).astype(float))
        n = directions[:, 0]  # the direction in which the points vary least
        d = n @ mean
    if abs(n[2]) < min_cosine:  # too steep: a wall, for example
        return scan
    return scan[~inliers(xyz, n, d)]


# ------------------------------------------------------------------------------------------------
# Long work: progress, processes, cache


def progress(items, total, what):
    """Yield the items and report on stderr: how many of `total` are done, the rate, the time left.

    On a terminal the line is rewritten in place. Elsewhere a line is printed every 10 s at first,
    and then at intervals of a tenth of the elapsed time.
    """
    if not sys.stderr:  # started without one
        yield from items
        return
    tty = sys.stderr.isatty()
    began, done = time.monotonic(), 0
    due = began + (0.2 if tty else 10)  # time of the next message [s]

    def say(end):
        rate = done / max(time.monotonic() - began, 1e-9)
        minutes, seconds = divmod(round((total - done) / rate), 60)
        line = f"{what}: {done}/{total}, {rate:.3g} /s, {minutes}:{seconds:02d} left"
        print(f"\r{line:<79}" if tty else line, end=end, file=sys.stderr, flush=True)

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
        return min(len(os.sched_getaffinity(0)), 61)
    return min(os.cpu_count() or 1, 61)


def in_processes(function, tasks, workers=None, chunksize=4):
    """Yield function(task) for every task, in order, computed by a pool of worker processes.

    workers: number of processes, None for one per core; chunksize: tasks sent to a worker at once.
    Raises OSError if a worker dies.
    """
    if not tasks:
        return
    pool = ProcessPoolExecutor(workers or cores(), initializer=_obey)
    try:
        yield from pool.map(function, tasks, chunksize=chunksize)
    except BrokenExecutor:
        raise OSError("a worker process died. Where processes are not forked (macOS, Windows, and "
                      "Linux from Python 3.14), a script needs the line if __name__ == '__main__': "
                      "before its main part. Otherwise check the free memory") from None
    finally:
        pool.shutdown(cancel_futures=True)


def _obey():
    """Make a worker ignore Ctrl-C, which the parent handles, and end at SIGTERM or with the parent.
    """
    def end_with_parent():
        multiprocessing.parent_process().join()
        os._exit(1)

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    threading.Thread(target=end_with_parent, daemon=True).start()


def treat_sigterm_as_interrupt():
    """Treat SIGTERM like Ctrl-C from now on, so that every `finally` runs."""
    if threading.current_thread() is threading.main_thread():  # only it may set handlers
        signal.signal(signal.SIGTERM, signal.default_int_handler)


def keep_freed_memory():
    """Let glibc keep large freed blocks instead of returning them to the system.

    Otherwise every allocation causes new page faults, which double the time of a training step on a
    CPU.
    """
    with suppress(OSError, AttributeError, TypeError):  # another C library
        libc = ctypes.CDLL(None)
        libc.mallopt(-4, 0)  # M_MMAP_MAX: large blocks come from the heap too
        libc.mallopt(-1, 2**31 - 1)  # M_TRIM_THRESHOLD: the heap never shrinks


def versions(folder):
    """Versions of Python and the packages, and the git commit of the code in `folder`, if any."""
    commit, git = None, shutil.which("git")
    if git and (Path(folder) / ".git").exists():
        describe = [git, "-C", folder, "describe", "--always", "--dirty"]
        commit = subprocess.run(describe, capture_output=True, text=True).stdout.strip()
    packages = {name: importlib.metadata.version(name) for name in ("numpy", "scipy", "torch")}
    return {"commit": commit, "python": platform.python_version(), **packages}


def cached_records(sequences, compute, dtype, settings, cache="cache"):
    """Compute a record for every scan and store it. Later calls read the stored records.

    sequences: a list of `Sequence`; compute: a picklable function from (path of a scan,
    intensity_max) to a record of `dtype`; settings: everything else that the records depend on;
    cache: the folder of the files. Returns a list with the records (n,) of each sequence,
    memory-mapped. The work is spread over all cores.

    A file's name is a hash of all it depends on, and files are moved into place when complete, so
    two processes may share a cache. A file that NumPy cannot read is computed again.
    """
    files, missing = [], []
    for s in sequences:
        stats = [path.stat() for path in s.scan_paths]  # ctime changes even where mtime is kept
        scans = [(stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns) for stat in stats]
        depends = str(s.folder.resolve()), scans, s.intensity_max, settings, dtype.descr
        key = hashlib.sha256(repr(depends).encode()).hexdigest()[:16]
        files.append(Path(cache) / f"{s.name}-{key}.npy")
        if _load(files[-1], dtype, len(s)) is None:
            missing.append((s, files[-1]))
    tasks = [(path, s.intensity_max) for s, _ in missing for path in s.scan_paths]
    with closing(in_processes(compute, tasks)) as records:
        records = progress(records, len(tasks), "sampling and grouping, scans")
        for s, file in missing:
            header = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False,
                      "shape": (len(s),)}
            # Written record by record: a memory map would crash on a full disk
            with replacing(file) as temporary, open(temporary, "wb") as out:
                np.lib.format.write_array_header_1_0(out, header)
                for _ in range(len(s)):
                    out.write(next(records).tobytes())
        next(records, None)  # lets the progress line end
    return [_load(file, dtype, len(s)) for s, file in zip(sequences, files)]


def _load(file, dtype, n):
    """The records (n,) in a cache file, or None. Reports a damaged file."""
    if not file.is_file():
        return None
    with suppress(Exception):  # np.load raises many exception types; all mean a corrupt file
        records = np.load(file, mmap_mode="r")  # pickles are off by default, so no code runs
        if (records.dtype, records.shape) == (dtype, (n,)):
            return records
    print(f"{file}: damaged, so it is computed again", file=sys.stderr)
    return None


@contextmanager
def new_folder(path):
    """Yield a temporary folder beside `path`, and move it to `path` if the block succeeds."""
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    temporary.mkdir(parents=True)
    try:
        yield temporary
        temporary.rename(path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


# ------------------------------------------------------------------------------------------------
# KITTI's raw drives: readme.txt of the raw data devkit, and oxts/dataformat.txt of each drive

EARTH_RADIUS = 6378137.0  # [m]; devkit: latlonToMercator.m
MAX_DELAY = np.timedelta64(100, "ms")  # a scan farther from every packet has no pose
SECOND = np.timedelta64(1, "s")


def convert_raw(drive: str | Path, root: str | Path) -> dict[str, tuple[int, int]]:
    """Convert an unpacked "sync" drive of KITTI's raw data to odometry layout, with ground truth.

    `drive` is a folder such as 2011_09_26/2011_09_26_drive_0013_sync, with the date's calib_*.txt
    in its parent folder. Writes ROOT/sequences/2011_09_26_drive_0013 and its ground truth in
    ROOT/poses, in the rectified left camera's frame. Scans are hard links where the file system
    allows it, else copies. A drive in which scans are missing is split at the gaps, into sequences
    whose names end with -1, -2 ... Returns {name of a sequence: (number of its first scan in the
    drive, of its last)}.

    The pose of a scan is that at the middle of its revolution, which is the time in
    velodyne_points/timestamps.txt and to which the "sync" data is aligned. The nearest GPS/IMU
    packet was recorded at another time, 12 to 25 ms later in drive 0013. So its pose is
    extrapolated with its velocity and angular velocity. The points are not corrected for the motion
    during the 0.1 s of a revolution.

    Raises FileNotFoundError for a missing file, naming its archive, and ValueError for a damaged
    one or if ROOT holds such a sequence already. ROOT is then unchanged.
    """
    drive, root = Path(os.path.abspath(drive)), Path(root)  # not resolved: a link keeps its place
    match = re.fullmatch(r"((\d{4}_\d\d_\d\d)_drive_\d+)_sync", drive.name)
    if not match:
        raise ValueError(f"{drive} is not a drive of KITTI's raw data: give a folder such as "
                         "2011_09_26/2011_09_26_drive_0013_sync, of the synced+rectified data.")
    name, date = match.groups()
    try:
        numbers, scans, times = _raw_stream(drive / "velodyne_points", ".bin")
        _, packets, packet_times = _raw_stream(drive / "oxts", ".txt")
        packets = np.stack([_read_packet(path) for path in packets])  # (m,30)
        Tr, T_velo_imu = _raw_calib(drive.parent)
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{error.filename} does not exist: unpack {name}_sync.zip and "
                                f"{date}_calib.zip.") from None
    for path in scans:
        _check_size(path)

    # The nearest packet of each scan, and the poses
    nearest = np.array([np.abs(packet_times - t).argmin() for t in times])  # (n,)
    delay = times - packet_times[nearest]  # (n,)
    has_pose = np.flatnonzero(np.abs(delay) < MAX_DELAY)
    if not len(has_pose):
        raise ValueError(f"{drive}: no scan was taken within 0.1 s of a GPS/IMU packet; "
                         f"unpack {name}_sync.zip again.")
    T_imu = _imu_poses(packets[nearest], delay / SECOND)  # (n,4,4)

    # Split the drive at the gaps. Poses and folders appear when all parts are written
    runs = np.split(has_pose, np.flatnonzero(np.diff(numbers[has_pose]) != 1) + 1)
    parts = {f"{name}-{i}" if len(runs) > 1 else name: run for i, run in enumerate(runs, 1)}
    for part in parts:
        for path in (root / "sequences" / part, root / "poses" / f"{part}.txt"):
            if path.exists():
                raise ValueError(f"{path} already exists: remove it or choose another ROOT.")
    with ExitStack() as stack:
        for part, run in parts.items():
            folder = stack.enter_context(new_folder(root / "sequences" / part))
            truth = stack.enter_context(replacing(root / "poses" / f"{part}.txt"))
            _write_raw_sequence(folder, [scans[i] for i in run], Tr, times[run])
            T = invert(T_imu[run[0]]) @ T_imu[run]  # relative to the first pose, IMU frame
            write_poses(truth, velo_to_camera(T, Tr @ T_velo_imu))
    return {part: (int(numbers[run[0]]), int(numbers[run[-1]])) for part, run in parts.items()}


def _write_raw_sequence(folder, scans, Tr, times):
    """Write the scans, calib.txt and times.txt of a sequence in odometry layout."""
    (folder / "velodyne").mkdir()
    for i, scan in enumerate(progress(scans, len(scans), "linking or copying scans")):
        target = folder / "velodyne" / f"{i:06d}.bin"
        try:
            os.link(scan.resolve(), target)
        except OSError:  # another file system, or one without links
            shutil.copyfile(scan, target)
    _write_calib_and_times(folder, Tr, (times - times[0]) / SECOND)


def _write_calib_and_times(folder, Tr, times, cameras=()):
    """Write calib.txt, with Tr (4,4) and the lines of cameras, and times.txt, times (n,) [s]."""
    row = " ".join(f"{x:.12e}" for x in Tr[:3].ravel())
    (folder / "calib.txt").write_text("".join([*cameras, f"Tr: {row}\n"]))
    (folder / "times.txt").write_text("".join(f"{t:.6f}\n" for t in times))


def _raw_stream(folder, suffix):
    """List the files of a stream that have a time: numbers (n,), paths (list), times (n,).

    Line i of timestamps.txt, counted from 0, is the time of file i, to the nanosecond. It is blank
    where the recording has lost a file, as in drive 2011_09_26_drive_0009.
    """
    lines = (folder / "timestamps.txt").read_bytes().decode("utf-8", "replace").splitlines()
    paths = sorted(path for path in folder.glob(f"data/*{suffix}")
                   if re.fullmatch("[0-9]{10}", path.stem))
    numbers = np.array([int(path.stem) for path in paths], int)
    if not paths:
        raise FileNotFoundError(errno.ENOENT, "", str(folder / "data" / f"0000000000{suffix}"))
    try:
        times = np.array([line.strip() for line in lines], "datetime64[ns]")[numbers]
    except (ValueError, IndexError):
        times = np.full(len(paths), np.datetime64("NaT"))
    known = np.flatnonzero(~np.isnat(times))  # a blank line becomes NaT, "not a time"
    if not len(known):
        raise ValueError(f"{folder}/timestamps.txt is damaged: line i should hold the time of file "
                         "i, such as 2011-09-26 13:10:51.158069617; unpack the drive again.")
    return numbers[known], [paths[i] for i in known], times[known]


def _read_packet(path):
    """Read a GPS/IMU packet: (30,) numbers in the order of oxts/dataformat.txt."""
    packet = parse(path.read_bytes().split(), 30)
    if not (np.isfinite(packet).all() and abs(packet[0]) < 90):
        raise ValueError(f"{path} is damaged: a GPS/IMU packet is 30 finite numbers, the first a "
                         "latitude; unpack the drive again.")
    return packet


def _raw_calib(folder):
    """Read the calib_*.txt of a date: Tr (4,4), Velodyne to rectified camera, and T_velo_imu."""
    def transform(name, rotation, translation=None):
        R = _calib_row(folder / name, rotation, 9).reshape(3, 3)
        t = _calib_row(folder / name, translation, 3) if translation else np.zeros(3)
        row = np.column_stack([R, t])  # (3,4)
        if not is_rigid(row):
            raise ValueError(f"{folder / name} is damaged: its row {rotation!r} should hold a "
                             "rotation, and 'T' a translation; unpack the date's calib.zip again.")
        return np.vstack([row, [0, 0, 0, 1]])  # (4,4)

    rectify = transform("calib_cam_to_cam.txt", "R_rect_00")
    T_cam_velo = transform("calib_velo_to_cam.txt", "R", "T")
    T_velo_imu = transform("calib_imu_to_velo.txt", "R", "T")
    return rectify @ T_cam_velo, T_velo_imu


def _imu_poses(packets, delay):
    """Poses T_wi (n,4,4) of the GPS/IMU unit (x forward, y left, z up) at the times of the scans.

    packets (n,30): the packet nearest to each scan; delay (n,): time from the packet to the scan
    [s]. The world is x east, y north, z up, in metres.

    The pose of a packet is that of the devkit's convertOxtsToPose.m: a Mercator projection, and
    roll, pitch, yaw about x, y, z in that order. From there to the scan, velocity and turn rate are
    taken as constant. The unit then moves along an arc, whose chord has the direction of the
    velocity half-way.
    """
    lat, lon, alt = packets[:, :3].T  # (n,) each; degrees, degrees, m
    velocity = packets[:, [7, 6, 10]]  # (n,3) m/s, to the east, to the north and upwards
    turn_rate = packets[:, 17:20]  # (n,3) rad/s, about the unit's x, y and z axes
    scale = EARTH_RADIUS * np.cos(np.radians(lat[0]))
    east = scale * np.radians(lon)
    north = scale * np.log(np.tan(np.radians(90 + lat) / 2))
    attitude = Rotation.from_euler("xyz", packets[:, 3:6])  # roll, pitch, yaw [rad]
    turn = attitude.apply(turn_rate) * delay[:, None]  # (n,3), about the axes of the world
    half_turn = Rotation.from_rotvec(turn / 2)
    position = np.stack([east, north, alt], axis=1) + half_turn.apply(velocity * delay[:, None])
    return rigid((Rotation.from_rotvec(turn) * attitude).as_matrix(), position)


# ------------------------------------------------------------------------------------------------
# The simulated city: the road and our drive
#
# Units are metres and radians, the frame is x east, y north, z up. The world is built on flat land
# out of upright prisms, boxes and cylinders; hills are added to the finished points. A prism is a
# row of 10 numbers: its centre; the heading of its x axis; half of its size along its own axes (the
# radius of a cylinder); the height of its bottom and top; its albedo; how deep light gets into it
# (foliage; 0 for a solid); 1 for a cylinder, 0 for a box.

X, Y, YAW, HALF_X, HALF_Y, Z0, Z1, ALBEDO, FUZZ, ROUND = range(10)

CITY = 4  # version; increase it when the city changes, so that scans of two versions never mix
LANE = 3.5  # width of a lane
SIDE_STREET = 70.0  # how far a side street goes on both sides of the road
SENSOR_HEIGHT, SENSOR_AHEAD = 1.73, 0.8  # above the road; ahead of the rear axle
MIN_RANGE, CITY_RANGE = 2.5, 80.0


class _Style(NamedTuple):
    """How a sequence drives, and through which surroundings."""

    cruise: float  # cruising speed [m/s]
    halts: int  # number of halts per 150 scans, in a queue at a light
    lanes: int  # number of lanes in each direction
    reservation: float  # width of the central reservation; with one, there are no side streets
    junctions: tuple  # odds of no junction, a street corner, a ramp and a roundabout
    surroundings: tuple  # odds of dense, suburban and open ones


STYLES = {
    "00": _Style(13, 1, 1, 0, (5, 5, 0, 1), (6, 3, 1)),
    "01": _Style(28, 0, 3, 3, (3, 0, 1, 0), (1, 6, 8)),
    "02": _Style(15, 0, 1, 0, (6, 2, 1, 1), (2, 6, 1)),
    "03": _Style(11, 0, 1, 0, (5, 3, 0, 2), (2, 5, 2)),
    "04": _Style(28, 0, 2, 3, (3, 0, 1, 0), (2, 5, 2)),
    "05": _Style(13, 1, 2, 0, (5, 5, 0, 1), (6, 3, 1)),
    "06": _Style(16, 0, 2, 0, (4, 1, 1, 1), (3, 5, 1)),
    "07": _Style(13, 1, 1, 0, (5, 4, 1, 1), (6, 3, 1)),
    "08": _Style(14, 1, 2, 0, (5, 4, 1, 1), (4, 4, 1)),
    "09": _Style(22, 0, 2, 2, (4, 0, 2, 1), (1, 5, 3)),
    "10": _Style(14, 1, 1, 0, (5, 2, 2, 2), (2, 4, 3)),
}


def _pieces_of_road(rng, style):
    """Draw a straight, a bend and a junction, a list of pieces (length, curvature, speed)."""
    stretch = rng.uniform(35, 80) * max(style.cruise / 15, 1) ** 2
    speed, side = style.cruise * rng.uniform(0.8, 1.0), rng.choice([-1, 1])
    lateral = rng.choice([0.0, rng.uniform(1.0, 2.8)])  # acceleration in the bend, if it is one
    bend = side * lateral / speed**2  # curvature [1/m]
    # A bend turns by 60 degrees at most
    arc = min(rng.uniform(0.5, 0.8) * stretch, np.radians(60) / max(abs(bend), 1e-6))

    # Turns at the junction: radius, and angle [degrees], positive to the left. A roundabout is
    # entered with a right turn, followed for a quarter or half of its circle, and exited with a
    # right turn.
    kind = rng.choice(4, p=np.array(style.junctions) / sum(style.junctions))
    corner = rng.uniform(7, 12) + LANE * (style.lanes - 1), side * rng.uniform(70, 100)
    ramp = rng.uniform(25, 32), side * rng.uniform(60, 150)
    radius = rng.uniform(19, 25)
    roundabout = [(radius, -45), (radius, rng.choice([90, 180])), (radius, -45)]
    turns = ([], [corner], [ramp], roundabout)[kind]
    pieces = [(stretch - arc, 0.0, speed), (arc, bend, speed)]
    for radius, angle in turns:
        pieces.append((radius * np.radians(abs(angle)), np.sign(angle) / radius, speed))
    return pieces


class _Drive:
    """A road and our drive along it, drawn at random. Places are given in metres along the road."""

    def __init__(self, rng, scans, style):
        step, start = 0.25, 100.0  # we start here, so there is road behind us as well
        pieces = []
        while sum(piece[0] for piece in pieces) < start + 0.13 * style.cruise * scans + 150:
            pieces += _pieces_of_road(rng, style)
        metres, curvature, limit = np.array(pieces).T
        repeats = np.round(metres / step).astype(int)
        curvature, limit = np.repeat(curvature, repeats), np.repeat(limit, repeats)

        def smooth(values, metres):
            return gaussian_filter(values, metres / step, mode="nearest")

        # The steering wheel turns gradually and is never quite still
        k = smooth(curvature, 1.7) + smooth(rng.normal(0, 0.01, len(curvature)), 8)
        s = self.s = np.arange(len(k)) * step
        self.length = s[-1]
        self.heading = np.cumsum(k) * step
        self.x, self.y = np.cumsum([np.cos(self.heading), np.sin(self.heading)], axis=1) * step

        # Speed: slower in bends, and nearly 0 at a halt; the first halt is at the start
        lateral = rng.uniform(3.4, 4.6)  # largest acceleration in bends [m/s2]
        halts = np.sort(rng.random(int(style.halts * scans / 150)))
        halts[:1] = 0
        self.halts = start + 0.07 * style.cruise * scans * halts
        v = np.minimum(limit, np.sqrt(lateral / np.maximum(np.abs(k), 1e-4)))
        for halt in self.halts:
            v[abs(s - halt) < 0.5] = 0.5
        for _ in range(2):  # accelerate, then, from the end to the start, brake by 2.5 m/s2 at most
            for i in range(1, len(v)):
                v[i] = min(v[i], np.sqrt(v[i - 1]**2 + 2 * 2.5 * step))
            v = v[::-1]

        # The time at every place; two times where we stand still
        t, driven = np.r_[0, np.cumsum(step / smooth(v, 1.0))[:-1]], s
        for halt in self.halts:
            i = np.searchsorted(driven, halt)
            t = np.r_[t[:i + 1], t[i:] + rng.uniform(1, 4)]
            driven = np.insert(driven, i, driven[i])
        self.t, self.driven = t - t[np.searchsorted(driven, start)], driven

    def position(self, at, left=0.0):
        """x, y and heading at the places `at`, `left` metres to the left of our path."""
        heading = np.interp(at, self.s, self.heading)
        x = np.interp(at, self.s, self.x) - left * np.sin(heading)
        return x, np.interp(at, self.s, self.y) + left * np.cos(heading), heading

    def distance(self, t):
        """The places where we are at the times t [s]."""
        return np.interp(t, self.t, self.driven)

    def is_measurable(self, scans):
        """Whether we come far (119 m in 170 scans), and turn enough, to the left and to the right.

        Otherwise E_t has no segment, or standing still has hardly an error in rotation.
        """
        s = self.distance(np.arange(scans + 1) * 0.1)
        turn = np.degrees(np.diff(self.position(s)[2]))  # from each scan to the next
        return (s[-1] - s[0] > 0.7 * min(scans, 170) and turn.std() > 0.85
                and min(turn.max(), -turn.min()) > 0.5)


def _sensor_poses(rng, drive, t):
    """Poses T_wt (n,4,4) of the Velodyne at times t (n,), on flat land.

    The car leans in bends, pitches when it brakes, and shakes.
    """
    def wave(size, low, high):  # the sum of five waves of random frequencies [Hz]
        frequency, phase = rng.uniform((low, 0), (high, 6.3), (5, 2)).T[..., None]
        return (size / 2 * np.sin(2 * np.pi * frequency * t + phase)).sum(axis=0)

    before, s, after = (drive.distance(t + dt) for dt in (-0.2, 0, 0.2))
    speed = (after - before) / 0.4  # [m/s]
    acceleration = (after - 2 * s + before) / 0.04  # [m/s2]
    turn = drive.position(after)[2] - drive.position(before)[2]
    lateral = speed * turn / 0.4  # acceleration [m/s2]
    shake = np.minimum(speed / 8, 1)  # a car at rest does not shake
    # In degrees
    roll = 0.25 * lateral + shake * (wave(0.25, 0.2, 0.8) + wave(0.12, 1, 2.5))
    pitch = shake * (wave(0.25, 0.2, 0.8) + wave(0.14, 1, 2.5))
    pitch -= 0.2 * gaussian_filter(acceleration, 2)
    z = SENSOR_HEIGHT + shake * wave(0.015, 0.3, 1.5)
    # The rear axle follows the road. The Velodyne is ahead of it, so turns also move it sideways.
    x, y, yaw = drive.position(s)
    R = Rotation.from_euler("xyz", np.stack([np.radians(roll), np.radians(pitch), yaw], axis=1))
    x, y = x + SENSOR_AHEAD * np.cos(yaw), y + SENSOR_AHEAD * np.sin(yaw)
    return rigid(R.as_matrix(), np.stack([x, y, z], axis=1))


def _hills(rng, T):
    """Draw hills. Returns height(x, y), and the poses T_wt (n,4,4) of the flat land on the hills.

    The height is a sum of waves 80 to 400 m long, with a slope of some 3 % (root mean square). A
    pose is lifted to the height of the land and tilted with its slope.
    """
    k = 2 * np.pi / np.geomspace(80, 400, 6)  # wave numbers [rad/m]
    direction, phase = rng.uniform(0, 2 * np.pi, (2, 6))
    waves = np.stack([k * np.cos(direction), k * np.sin(direction), phase, 0.017 / k], 1).tolist()

    def height(x, y):
        return sum(size * np.sin(kx * x + ky * y + phase) for kx, ky, phase, size in waves)

    x, y, z = T[:, :3, 3].T
    slope_x = height(x + 0.5, y) - height(x - 0.5, y)
    slope_y = height(x, y + 0.5) - height(x, y - 0.5)
    tilt = Rotation.from_rotvec(np.stack([slope_y, -slope_x, 0 * x], axis=1)).as_matrix()
    return height, rigid(tilt @ T[:, :3, :3], np.stack([x, y, z + height(x, y)], axis=1))


# What stands along the road


def _prisms(*columns):
    """The 10 columns of prisms, numbers or arrays (n,) -> (n,10)."""
    arrays = np.broadcast_arrays(*(np.asarray(column, float) for column in columns))
    return np.stack(arrays, axis=-1).reshape(-1, 10)


# Vehicles, from and to: length, height; then half of the width; the waist, which is the height of
# the lower part; length of the upper part and its shift to the rear, in lengths of the vehicle;
# albedo of the upper part relative to the lower, low where there are windows
VEHICLES = np.array([
    (3.6, 4.8, 1.4, 1.6, 0.88, 0.9, 0.58, 0.08, 0.6),  # car
    (5.0, 6.5, 2.0, 2.8, 0.95, 1.1, 0.80, 0.10, 0.8),  # van
    (7.0, 15.0, 3.2, 4.0, 1.25, 2.6, 0.75, 0.12, 1.2),  # lorry
    (10.0, 13.0, 2.9, 3.3, 1.25, 1.2, 1.00, 0.00, 0.7),  # bus
])
PARKED, MOVING = (0.88, 0.12, 0, 0), (0.76, 0.12, 0.08, 0.04)  # shares of these four


def _vehicles(rng, n, shares):
    """Draw n vehicles at the origin, heading along x -> prisms (2,n,10): lower and upper parts."""
    kind = VEHICLES[rng.choice(len(VEHICLES), n, p=shares)].T
    length, height = rng.uniform(kind[0], kind[1]), rng.uniform(kind[2], kind[3])
    half_width, waist, share, back, dim = kind[4:]
    albedo = 0.02 + 0.5 * rng.random(n) ** 2  # many are dark
    lower = _prisms(0, 0, 0, length / 2, half_width, 0.25, waist, albedo, 0, 0)
    upper = _prisms(-back * length, 0, 0, share * length / 2, half_width - 0.1, waist, height,
                    dim * albedo, 0, 0)
    return np.stack([lower, upper])


def _place(vehicles, x, y, yaw):
    """Move vehicles (2,n,10) from the origin to places (n,) -> prisms (2n,10)."""
    placed = vehicles.copy()
    placed[..., X] = x + vehicles[..., X] * np.cos(yaw)
    placed[..., Y] = y + vehicles[..., X] * np.sin(yaw)
    placed[..., YAW] = yaw
    return placed.reshape(-1, 10)


class _Street:
    """One side of the road. What stands there is collected in the list `prisms`.

    side: 1 for the left side, -1 for the right; edge: distance from our path to the edge of the
    road; zones: the surroundings of every 70 m, 0 for dense, 1 for suburban and 2 for open ones.
    """

    def __init__(self, rng, drive, side, edge, zones):
        self.rng, self.drive, self.prisms = rng, drive, []
        self.side, self.edge, self.zones = side, edge, zones

    def put(self, s, out, half_x, half_y, z1, albedo, fuzz=0, twist=0, z0=0):
        """A box `out` metres beyond the edge of the road, or a cylinder if half_y is None."""
        x, y, yaw = self.drive.position(s, self.side * (self.edge + out))
        self.prisms.append(_prisms(x, y, yaw + twist, half_x, half_y or half_x, z0, z1, albedo,
                                   fuzz, half_y is None))

    def tree(self, s, out):
        """A trunk and a crown."""
        u = self.rng.uniform
        radius, crown = u(0.1, 0.3), u(1.2, 3.2)  # of the trunk; where the crown begins
        self.put(s, out, radius, None, crown + 1, u(0.15, 0.35))
        self.put(s, out, u(1.2, 3.5), None, crown + u(3, 7), u(0.2, 0.45), u(0.5, 2.5), z0=crown)

    def plots(self):
        """Houses and gardens, one plot after the other."""
        rng, u, s = self.rng, self.rng.uniform, 0.0
        while s < self.drive.length:
            zone = self.zones[int(s / 70)]
            plot = u(9, (22, 16, 16)[zone])  # its length along the road
            setback, middle = u((3.5, 6, 8)[zone], (7, 14, 30)[zone]), s + plot / 2
            if rng.random() < (0.95, 0.8, 0.3)[zone]:
                self.house(middle, setback, plot)
            if zone > 0 and rng.random() < 0.65:  # a hedge, or a wall or fence
                thick, fuzz = (0.35, 0.25) if rng.random() < 0.6 else (0.1, 0)
                self.put(middle, u(2.2, 3.2), plot * u(0.3, 0.48), thick, u(0.6, 1.9), u(0.2, 0.4),
                         fuzz)
            for _ in range(rng.poisson((1, 3, 3)[zone])):  # each time a tree and a bush
                self.tree(s + u(0, 1) * plot, u(3, setback + 3))
                self.put(s + u(0, 1) * plot, u(3, 7), u(0.4, 1.2), None, u(0.5, 1.8), u(0.2, 0.4),
                         0.25)
            # A gap to the next plot, wide or narrow
            s += plot + (u(5, 14) if zone > 0 or rng.random() < 0.35 else u(0, 1))

    def house(self, s, setback, plot):
        """A house with bays, stairs and porches, without which all of a facade looks the same."""
        u, depth, albedo = self.rng.uniform, self.rng.uniform(7, 13), self.rng.uniform(0.2, 0.42)
        self.put(s, setback + depth / 2, plot / 2, depth / 2, u(5, 14), albedo,
                 twist=self.rng.normal() * 0.02)
        for _ in range(self.rng.integers(2, 6)):
            thick = u(0.1, 0.5)
            self.put(s + u(-0.45, 0.45) * plot, setback - thick, u(0.3, 1.5), thick, u(1, 7),
                     albedo * u(0.7, 1.3))

    def pavement(self):
        """Trees, poles of lamps and signs, and boxes."""
        u, s = self.rng.uniform, 0.0
        while s < self.drive.length:
            choice = u(0, 1)
            if choice < 0.35:
                self.tree(s, u(2.2, 3))
            elif choice < 0.7:
                self.put(s, u(0.5, 2.5), u(0.04, 0.12), None, u(2.5, 8), u(0.2, 0.6))
            elif choice < 0.9:
                self.put(s, u(2.2, 3), u(0.2, 0.6), u(0.2, 0.4), u(0.7, 1.7), u(0.1, 0.6))
            s += u(2, 11)

    def background(self):
        """Houses, trees and thickets up to 65 m away, seen between the plots."""
        rng, u = self.rng, self.rng.uniform
        for _ in range(int(self.drive.length / 4)):
            s, out, choice = u(0, self.drive.length), u(6, 65), rng.random()
            if choice < 0.3:
                self.put(s, out, u(4, 12), u(4, 8), u(4, 12), u(0.2, 0.4), 0, rng.normal() * 0.3)
            elif choice < 0.6:
                self.tree(s, out)
            else:
                self.put(s, out, u(1, 8), u(1, 4), u(1, 8), u(0.2, 0.45), u(1, 4),
                         rng.normal() * 0.5)

    def parked_cars(self):
        """Cars along the edge of the road."""
        rng, s = self.rng, 0.0
        while s < self.drive.length:
            car = _vehicles(rng, 1, PARKED)
            if rng.random() < (0.7, 0.5, 0.1)[self.zones[int(s / 70)]]:
                x, y, yaw = self.drive.position(s, self.side * (self.edge + rng.uniform(1.2, 1.5)))
                self.prisms.append(_place(car, x, y, yaw + rng.normal() * 0.03))
            s += 2 * car[0, 0, HALF_X] + rng.uniform(0.6, 3)

    def barrier(self, out):
        """A crash barrier `out` metres beyond the edge of the road."""
        for s in np.arange(0, self.drive.length, 4.0):
            self.put(s, out, 2.0, 0.1, 0.8, 0.4, z0=0.4)


def _roadside(rng, drive, lanes, style):
    """Draw everything that stands along the road -> prisms (n,10)."""
    odds = np.array(style.surroundings)
    zones = rng.choice(3, p=odds / sum(odds), size=(2, int(drive.length / 70) + 1))
    left = _Street(rng, drive, 1, lanes[1].max() + LANE / 2, zones[0])
    right = _Street(rng, drive, -1, LANE / 2 - lanes[0].min(), zones[1])
    for street in left, right:
        street.plots()
        street.pavement()
        street.background()
        if style.reservation:
            street.barrier(1.5)
        else:
            street.parked_cars()
    if style.reservation:  # in its middle
        left.barrier(-len(lanes[1]) * LANE - style.reservation / 2)
    return np.concatenate(left.prisms + right.prisms)


CELL = 0.5  # size of a cell of the ground


def _ground(rng, drive, lanes, side_streets):
    """Draw the ground: road and side streets, kerb, pavement and rough grass.

    Returns the height, 0 only on roads, and the albedo of every cell, and the raster's corner (2,).
    """
    f4, step = np.float32, CELL / 2
    along, across = np.arange(0, drive.length, step), np.arange(-SIDE_STREET, SIDE_STREET, step)
    areas = [(along, np.arange(way.min() - LANE / 2 + step, way.max() + LANE / 2, step))
             for way in lanes]
    areas += [(np.arange(s - LANE + step, s + LANE, step), across) for s in side_streets]
    points = [np.stack(drive.position(s[:, None], left)[:2]).reshape(2, -1) for s, left in areas]
    points = np.concatenate(points, axis=1)  # (2,m)
    corner = points.min(axis=1) - 85
    i, j = ((points - corner[:, None]) / CELL).astype(int)
    off_road = np.ones((i.max() + int(90 / CELL), j.max() + int(90 / CELL)), bool)
    off_road[i, j] = False
    away = distance_transform_edt(off_road).astype(f4) * CELL  # from the road
    grass = np.clip((away - 2.5) / 6, 0, 1)  # from 0 on the pavement to 1
    # Noise of standard deviation 1, about 4 m wide
    noise = gaussian_filter(rng.standard_normal(off_road.shape, dtype=f4), 8) * 28
    height = np.where(off_road, 0.12, 0) + grass * np.clip(0.15 + 0.2 * noise, 0, 0.6)
    albedo = 0.33 + np.where(off_road, 0.03, 0) + 0.03 * noise - 0.04 * grass
    return height.astype(f4), albedo.astype(f4), corner


def _leaves_road_clear(prisms, ground):
    """Which prisms (n,10) are off the road or, like crowns, begin 2.2 m above it -> (n,) bool."""
    height, _, corner = ground
    x, y, yaw, half_x, half_y = prisms[:, [X, Y, YAW, HALF_X, HALF_Y]].T[:, :, None, None]
    along, across = half_x * np.linspace(-1, 1, 9)[:, None], half_y * np.linspace(-1, 1, 9)
    i = (x + along * np.cos(yaw) - across * np.sin(yaw) - corner[0]) / CELL  # (n,9,9)
    j = (y + along * np.sin(yaw) + across * np.cos(yaw) - corner[1]) / CELL
    i, j = (np.clip(k, 0, n - 1).astype(int) for k, n in zip((i, j), height.shape))
    return (height[i, j] > 0).all(axis=(1, 2)) | (prisms[:, Z0] > 2.2)


# Traffic


def _lane_with_us(rng, drive, t, left):
    """Draw the vehicles of a lane in our direction: prisms (2,n,10), places (n,scans).

    Each does what the one ahead of it does, a little later and some metres behind (Newell's model
    of car following). All follow our own drive, so they slow down in bends and queue at lights with
    us. Vehicles to our left are faster than we are and those to our right slower, by 2 to 30 %.
    """
    own = drive.distance(t)
    driven = own[-1] - own[0]
    rate = 1 + np.sign(left) * rng.choice([0.02, rng.uniform(0.05, 0.3)])
    # Twice as many as are ever seen, 90 m ahead and behind, at our mean speed
    spacing = 8 + 1.3 * driven / len(t) / 0.1
    n = 1 + int((360 + 4 * abs(rate - 1) * driven) / spacing)
    vehicles = _vehicles(rng, n, MOVING)
    half = vehicles[0, :, HALF_X, None]  # of the length (n,1)
    offset = np.cumsum(2 * half + rng.uniform(2, 5, (n, 1)), axis=0) - half
    lead = np.cumsum(rng.uniform(0.7, 2.0, (n, 1)), axis=0)  # [s]
    # The vehicle in the middle is beside us or, in our lane, in our place
    offset, lead = offset - offset[n // 2], lead - lead[n // 2]
    wave, phase = rng.uniform(0.2, 0.6, (n, 1)), rng.uniform(0, 6.3, (n, 1))
    lead = lead + 0.25 * np.sin(wave * t + phase)  # (n,scans); distances are never quite constant
    s = own[0] + offset + rate * (drive.distance(t + lead) - own[0])
    # In our own lane, keep only those less than 25 m ahead. At a halt they stand on this side of
    # the light, so the side street stays free.
    free = (offset + half < 25)[:, 0] | (left != 0)
    return vehicles[:, free], s[free]


def _traffic(rng, drive, t, lanes, side_streets, style):
    """Draw all vehicles on the road at times t (scans,): moving(i) -> prisms (m,10) at scan i."""
    groups = []

    def add(vehicles, s, left, turn):
        """Add n vehicles: prisms (2,n,10), places s (n,scans) along the road, metres to the left of
        our path, angle to the road."""
        groups.append((vehicles, np.broadcast_arrays(s, left, turn)))

    # Our own car comes first, so that others make way for it. Its middle is below the sensor.
    own = drive.distance(t)  # of our rear axle
    car = _prisms(0, 0, 0, 2.5, 1.0, 0, 2, 0, 0, 0)[None].repeat(2, axis=0)
    add(car, own[None] + SENSOR_AHEAD, 0, 0)
    for left in lanes[0]:
        add(*_lane_with_us(rng, drive, t, left), left, 0)
    for left in lanes[1]:  # towards us, at the speed of their lane
        speed = style.cruise * rng.uniform(0.6, 1.0)
        n = int((drive.length + speed * t[-1]) / 40)
        start = np.cumsum(rng.uniform(20, 60, (n, 1)), axis=0)
        add(_vehicles(rng, n, MOVING), start - speed * t, left, np.pi)
    for street in side_streets:  # across, at about the time when we are there
        side, speed = rng.choice([-1, 1], (8, 1)), rng.uniform(4, 12, (8, 1))
        our_time = t[np.searchsorted(own, street - 20).clip(0, len(t) - 1)]
        left = side * speed * (t - our_time - rng.uniform(-8, 8, (8, 1)))
        add(_vehicles(rng, 8, MOVING), street + side * LANE / 2, left, side * np.pi / 2)

    vehicles = np.concatenate([vehicles for vehicles, _ in groups], axis=1)  # (2,n,10)
    s, left, turn = np.concatenate([motion for _, motion in groups], axis=1)  # (n,scans) each
    x, y, yaw = drive.position(s, left)
    yaw = yaw + turn
    seen = (np.hypot(x - x[0], y - y[0]) < CITY_RANGE + 10) & (np.abs(left) < SIDE_STREET)
    seen &= (s > 0) & (s < drive.length)
    _remove_collisions(x, y, yaw, seen, vehicles)
    seen[0] = False  # our own car

    def moving(i):
        k = np.flatnonzero(seen[:, i])
        return _place(vehicles[:, k], x[k, i], y[k, i], yaw[k, i])

    return moving


def _remove_collisions(x, y, yaw, seen, vehicles):
    """Set seen (n,scans) to False for each vehicle that ever overlaps one earlier in the list.

    Vehicles are approximated by five discs in a row.
    """
    half_x, half_y = vehicles[0, :, HALF_X, None] + 0.2, vehicles[0, :, HALF_Y, None] + 0.1
    ends = np.linspace(-1, 1, 5)[:, None, None] * (half_x - half_y)
    disc_x, disc_y = x + ends * np.cos(yaw), y + ends * np.sin(yaw)  # (5,n,scans)
    for j in range(1, len(x)):
        both = seen[:j] & seen[j] & (np.hypot(x[:j] - x[j], y[:j] - y[j]) < 20)
        i, k = np.nonzero(both)  # the other vehicle and the scan
        dx = disc_x[:, None, i, k] - disc_x[:, j, k]  # (5,5,m)
        dy = disc_y[:, None, i, k] - disc_y[:, j, k]
        if (np.hypot(dx, dy) < half_y[i, 0] + half_y[j]).any():
            seen[j] = False


class _World:
    """The world of a sequence: where the sensor goes, and what it can see.

    T, T_flat (scans,4,4): poses T_wt of the Velodyne, on the hills and before they were added;
    prisms (n,10): what stands still; moving(i) -> prisms (m,10) of the vehicles at scan i; ground:
    see `_ground`; height(x, y): the hills. The random numbers depend on the sequence's name, so it
    does not matter which others are made with it.
    """

    def __init__(self, name, seed, scans):
        style, t = STYLES.get(name, STYLES["00"]), np.arange(scans) * 0.1  # [s]
        rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
        for _ in range(1000):  # draw again until the drive can be measured
            drive = _Drive(rng, scans, style)
            if scans < 100 or drive.is_measurable(scans):
                break
        drive.length = min(drive.length, drive.distance(scans * 0.1) + 120)  # the rest is not seen
        self.T_flat = _sensor_poses(rng, drive, t)
        # Lanes in our direction, and in the other: metres to the left of our path. Our own is at 0.
        ours = (np.arange(style.lanes) - rng.integers(style.lanes)) * LANE
        lanes = ours, ours.max() + style.reservation + LANE * np.arange(1, style.lanes + 1)
        # Side streets: 30 m ahead of every halt, where the light is, and elsewhere; only where the
        # road is straight
        at = np.r_[drive.halts + 30, rng.uniform(0, drive.length, int(drive.length / 120))]
        turn = drive.position(at + 8)[2] - drive.position(at - 8)[2]
        side_streets = at[(np.abs(turn) < 0.1) & (style.reservation == 0)]
        self.ground = _ground(rng, drive, lanes, side_streets)
        prisms = _roadside(rng, drive, lanes, style)
        self.prisms = prisms[_leaves_road_clear(prisms, self.ground)]
        self.moving = _traffic(rng, drive, t, lanes, side_streets, style)
        self.height, self.T = _hills(rng, self.T_flat)


# The sensor

# Elevation of the 64 beams of an HDL-64E, from the lowest to the highest
ELEVATION = np.radians(np.r_[np.linspace(-24.33, -8.83, 32), np.linspace(-8.33, 2.0, 32)])
RELIEF = 0.4  # depth of windows and doors, in prisms higher than 3 m


class _Rays:
    """The rays of a scan, numbered by beam, from the top, and by column.

    All rays of a column have the same azimuth in the world, so seen from above they are one line.
    There are A columns. Roll and pitch change a ray's elevation: e in the sensor's frame and w in
    the world are related by sin(e) = n . ray = gain * sin(w + tilt), with the sensor's up axis n.
    """

    def __init__(self, R, azimuth, rng):
        self.step = 2 * np.pi / azimuth  # angle from a column to the next
        self.a0 = np.arctan2(R[1, 0], R[0, 0]) + self.step * rng.random()  # of the first column
        a = self.a0 + self.step * np.arange(azimuth)  # (A,)
        along = R[0, 2] * np.cos(a) + R[1, 2] * np.sin(a)
        self.cos_a, self.sin_a, self.tilt, self.gain = np.float32(
            [np.cos(a), np.sin(a), np.arctan2(along, R[2, 2]), np.hypot(along, R[2, 2])])
        sin_e = np.float32(np.sin(ELEVATION[::-1]))[:, None]  # (64,1)
        w = np.arcsin(sin_e / self.gain) - self.tilt  # (64,A)
        self.sin_w, self.cos_w = np.sin(w).ravel(), np.cos(w).ravel()  # (64 A,)
        self.slope = self.sin_w / self.cos_w

    def beams_below(self, slope, col):
        """The number of beams of a column that are below `slope`."""
        sin_e = self.gain[col] * np.sin(np.arctan(slope) + self.tilt[col])
        return np.searchsorted(ELEVATION, np.arcsin(np.clip(sin_e, -1, 1)))


def _expand_ranges(first, count):
    """Ranges of integers, count[i] numbers from first[i] on -> the i of each, and the numbers."""
    i = np.repeat(np.arange(len(count)), count)
    return i, np.arange(len(i)) + np.repeat(first - np.cumsum(count) + count, count)


def _crossings(p, eye, rays):
    """Where columns of rays cross prisms (n,10), seen from above.

    Returns five arrays, a number for each crossing: prism, column, distance at which the column
    enters the prism and leaves it, cosine of the angle of incidence. A box is the intersection of
    two slabs, a cylinder a disc.
    """
    dx, dy, half_x, half_y = p[:, X] - eye[0], p[:, Y] - eye[1], p[:, HALF_X], p[:, HALF_Y]
    c, s = np.cos(p[:, YAW]), np.sin(p[:, YAW])
    x, y = -(c * dx + s * dy), s * dx - c * dy  # the eye in the prism's frame

    # Candidates are the columns between the leftmost and the rightmost corner
    corner_x, corner_y = half_x * [[1], [1], [-1], [-1]], half_y * [[1], [-1], [1], [-1]]  # (4,n)
    to_x, to_y = dx + c * corner_x - s * corner_y, dy + s * corner_x + c * corner_y
    centre = np.arctan2(dy, dx)
    wide = (np.arctan2(to_y, to_x) - centre + np.pi) % (2 * np.pi) - np.pi
    first = np.ceil((centre + wide.min(axis=0) - rays.a0) / rays.step).astype(int)
    last = np.floor((centre + wide.max(axis=0) - rays.a0) / rays.step).astype(int)
    # From inside a prism, seen from above, all columns would cross it; it is left out
    inside = (np.abs(x) < half_x + 0.3) & (np.abs(y) < half_y + 0.3)
    k, col = _expand_ranges(first, np.where(inside, 0, last - first + 1))
    col %= len(rays.cos_a)

    c, s, dx, dy, x, y, half_x, half_y, disc = np.float32(
        [c, s, dx, dy, x, y, half_x, half_y, p[:, ROUND]])[:, k]
    ca, sa = rays.cos_a[col], rays.sin_a[col]
    with np.errstate(divide="ignore", invalid="ignore"):
        per_x, per_y = 1 / (c * ca + s * sa), 1 / (c * sa - s * ca)  # way along the ray for 1 m
        slab_x, slab_y = half_x * np.abs(per_x), half_y * np.abs(per_y)
        enter_x, leave_x = -x * per_x - slab_x, -x * per_x + slab_x
        enter_y, leave_y = -y * per_y - slab_y, -y * per_y + slab_y
        cosine = 1 / np.abs(np.where(enter_x > enter_y, per_x, per_y))
        box = np.maximum(enter_x, enter_y), np.minimum(leave_x, leave_y), cosine
        middle = dx * ca + dy * sa  # the point nearest to the cylinder's axis
        half_chord = np.sqrt(np.maximum(half_x**2 - (dx * sa - dy * ca) ** 2, 0))
        cylinder = middle - half_chord, middle + half_chord, half_chord / half_x
        enter, leave, facing = np.where(disc > 0, cylinder, box)
    met = (enter < leave) & (enter > 0.5)
    return k[met], col[met], enter[met], leave[met], facing[met]


def _hit_prisms(p, eye, rays, rng):
    """The first hit of each ray on prisms (n,10).

    Returns (4,64 A): distance in plan (infinite for no hit), cosine of the angle of incidence,
    albedo, and the depth to which light can get in.
    """
    distance, h = np.hypot(p[:, X] - eye[0], p[:, Y] - eye[1]), np.float32(eye[2])
    p = p[distance - np.hypot(p[:, HALF_X], p[:, HALF_Y]) < CITY_RANGE]
    k, col, enter, leave, facing = _crossings(p, eye, rays)
    z0, z1, albedo, fuzz = np.float32([p[:, Z0] - h, p[:, Z1] - h, p[:, ALBEDO], p[:, FUZZ]])[:, k]

    # Nothing is seen behind a solid prism that stops every beam of its column
    # (the first slopes are those of the top beam)
    full = (z0 <= 0.01 - h) & (z1 > enter * rays.slope[col]) & (fuzz == 0)
    wall = np.full(len(rays.cos_a), CITY_RANGE, np.float32)  # (A,) distance to such a prism
    np.minimum.at(wall, col[full], enter[full])
    seen = enter <= wall[col]
    col, enter, leave, facing, z0, z1, albedo, fuzz = (
        values[seen] for values in (col, enter, leave, facing, z0, z1, albedo, fuzz))

    # Candidates are the beams from the highest to the lowest visible edge of a prism. If we look
    # down on it, the highest is the far edge of its top.
    low = rays.beams_below(z0 / np.where(z0 > 0, leave, enter), col)
    high = rays.beams_below(z1 / np.where(z1 > 0, enter, leave), col)
    g, beam = _expand_ranges(low, np.maximum(high - low, 0))
    stops = (fuzz == 0)[g] | (rng.random(len(g), np.float32) > 0.3)  # foliage has holes
    g, beam = g[stops], beam[stops]
    ray = (63 - beam) * len(rays.cos_a) + col[g]

    # A ray hits the face of the prism or, above or below it, its top or its bottom
    slope = rays.slope[ray]
    above, below = slope * enter[g] > z1[g] + 1e-3, slope * enter[g] < z0[g] - 1e-3
    on_level = above | below
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = np.where(on_level, np.where(above, z1[g], z0[g]) / slope, enter[g])

    # Keep the nearest hit of each ray
    hits = np.zeros((4, len(rays.slope)), np.float32)
    hits[0] = np.inf
    np.minimum.at(hits[0], ray, reach)
    best = reach <= hits[0, ray]
    ray, g, on_level = ray[best], g[best], on_level[best]
    relief = np.where(fuzz > 0, fuzz, np.where(z1 - z0 > 3, RELIEF, 0))
    cosine = np.where(on_level, np.abs(rays.sin_w[ray]), facing[g] * rays.cos_w[ray])
    hits[1:, ray] = cosine, albedo[g], relief[g]
    return hits


def _hit_ground(hits, ground, eye, rays):
    """Add to the `hits` of `_hit_prisms` the ground, for rays that have hit nothing so far.

    Where the bonnet or the boot of our own car hides the ground, the beam returns nothing.
    """
    (height, albedo, corner), azimuth, h = ground, len(rays.cos_a), np.float32(eye[2])
    off_axis = np.abs((rays.step * np.arange(azimuth) + np.pi) % (2 * np.pi) - np.pi)
    blocked = np.where(off_axis < 0.4, 6, np.where(off_axis > 2.55, 13, 0))  # number of beams
    own_car = np.arange(64)[:, None] >= 64 - blocked  # (64,A)
    descending = rays.slope < -h / np.float32(CITY_RANGE)
    ray = np.flatnonzero((hits[0] == np.inf) & descending & ~own_car.ravel())

    # Intersect the ray with the plane z = 0, then twice with the height of the ground found there
    col, slope = ray % azimuth, rays.slope[ray]
    x0, y0 = np.float32(eye[:2] - corner)
    reach = -h / slope
    for _ in range(2):
        i = ((x0 + reach * rays.cos_a[col]) / CELL).astype(int)
        j = ((y0 + reach * rays.sin_a[col]) / CELL).astype(int)
        reach = (height[i, j] - h) / slope
    hits[:3, ray] = reach, -rays.sin_w[ray], albedo[i, j]


def _returns(hits, eye, rays, rng):
    """What the sensor measures of the `hits` of all rays.

    Returns the numbers of the rays that return a point, their ranges [m] and intensities, (N,)
    each.
    """
    ray = np.flatnonzero(hits[0] < CITY_RANGE)  # (M,)
    col = ray % len(rays.cos_a)
    d, cosine, albedo, depth = hits[:, ray]
    noise = functools.partial(rng.standard_normal, len(ray), np.float32)
    uniform = functools.partial(rng.random, len(ray), np.float32)

    # Range. Light gets into foliage, or into the windows and doors of a facade, by a depth that is
    # random for each cell of 0.6 m but the same in every scan.
    directions = rays.cos_a[col], rays.sin_a[col], rays.slope[ray]  # for each metre in plan
    a, b, c = (np.floor((start + d * direction) / 0.6).astype(int)
               for start, direction in zip(eye, directions))  # number of the cell
    rough = np.float32((a * 73856093 ^ b * 19349663 ^ c * 83492791) % 1009) / 1009  # 0 to 1
    r = d / rays.cos_w[ray] + 0.02 * noise() + depth * (0.8 * rough + 0.2 * uniform())

    # Intensity. From 60 m on, KITTI's intensities are mostly 0; elsewhere 8 % are.
    light = albedo * (0.65 + 0.4 * np.sqrt(cosine)) + 0.08 * noise() - 0.01 * np.maximum(r - 25, 0)
    light = np.where(uniform() > 0.08, light, 0)
    # Lost returns: one in a hundred, and those far and dark, grazing, or very dark
    far = 0.10 * (r / 40) ** 2 * (0.15 / (0.05 + albedo))
    lost = 0.01 + far + 0.3 * np.exp(-cosine / 0.02) + 0.5 * np.exp(-albedo / 0.03)
    returned = (uniform() > lost) & (r < CITY_RANGE) & (r > MIN_RANGE)
    return ray[returned], r[returned], np.round(np.clip(light, 0, 0.99), 2)[returned]


def _simulate_scan(world, rng, azimuth, i):
    """Scan i -> (N,4) float32, beam by beam from the top.

    This is fast because a column of rays is one line in plan: its crossing with a prism is computed
    once for all beams. The heights of the prism's bottom and top then tell which beams hit it.
    """
    R, R_flat, eye = world.T[i, :3, :3], world.T_flat[i, :3, :3], world.T_flat[i, :3, 3]
    rays = _Rays(R_flat, azimuth, rng)
    hits = _hit_prisms(np.concatenate([world.prisms, world.moving(i)]), eye, rays, rng)
    _hit_ground(hits, world.ground, eye, rays)
    ray, r, intensity = _returns(hits, eye, rays, rng)

    # Points relative to the eye along the axes of the world. The hills lift them: a crest does not
    # hide anything.
    d, col = r * rays.cos_w[ray], ray % azimuth
    x, y, z = d * rays.cos_a[col], d * rays.sin_a[col], r * rays.sin_w[ray]
    lift = world.height(x + np.float32(eye[0]), y + np.float32(eye[1])) - world.height(*eye[:2])
    z += np.float32(lift)
    # Rotate them by R^T to the sensor's axes; without BLAS, whose sums depend on its threads
    points = [x * row[0] + y * row[1] + z * row[2] for row in np.float32(R.T)]
    return np.stack([*points, intensity], axis=1)


# Writing sequences

_world = functools.lru_cache(maxsize=1)(_World)
# As in KITTI, the camera looks along the Velodyne's x axis, 8 cm lower and 27 cm ahead. It is
# turned by a fraction of a degree.
_TURN = Rotation.from_euler("xyz", [0.4, -0.5, 0.3], degrees=True).as_matrix()
_TR = rigid(_TURN @ [[0, -1, 0], [0, 0, -1], [1, 0, 0]], [-0.012, -0.076, -0.272])
_CAMERAS = [f"P{i}: 718.856 0 607.193 {x} 0 718.856 185.216 0 0 0 1 0\n"
            for i, x in enumerate((0, -386.1, 45.4, -337.3))]


def _save_scan(task):
    """Simulate a scan and write it; task: path, sequence, settings, number of the scan."""
    path, name, settings, i = task
    world = _world(name, settings["seed"], settings["scans"])
    # The random numbers depend on the scan, so it does not matter which process makes it
    rng = np.random.default_rng([settings["seed"], zlib.crc32(name.encode()), i])
    with replacing(path) as temporary:
        temporary.write_bytes(_simulate_scan(world, rng, settings["azimuth"], i).tobytes())


def _is_complete(root, name, settings):
    """Whether ROOT holds this sequence, simulated with these settings.

    Raises ValueError if it holds another one of this name.
    """
    folder, truth = root / "sequences" / name, root / "poses" / f"{name}.txt"
    if not (folder.exists() or truth.exists()):
        return False
    made = folder / "simulated.json"
    found = made.read_text() if made.exists() else "not simulated"
    if found != json.dumps(settings) or not truth.exists():
        raise ValueError(f"{folder} or {truth} is there already, {found} and not "
                         f"{json.dumps(settings)}: delete it, or choose another folder.")
    return True


def _simulate_sequence(root, name, settings, workers):
    """Write ROOT/sequences/NAME and ROOT/poses/NAME.txt."""
    T = _world(name, settings["seed"], settings["scans"]).T
    sequence, poses = root / "sequences" / name, root / "poses" / f"{name}.txt"
    with new_folder(sequence) as folder, replacing(poses) as truth:  # both appear when complete
        (folder / "velodyne").mkdir()
        tasks = [(folder / "velodyne" / f"{i:06d}.bin", name, settings, i) for i in range(len(T))]
        alone = workers == 1 or len(tasks) <= 8
        saved = map(_save_scan, tasks) if alone else in_processes(_save_scan, tasks, workers, 8)
        for _ in progress(saved, len(tasks), f"simulating {name}, scans"):
            pass
        _write_calib_and_times(folder, _TR, 0.1 * np.arange(len(T)), _CAMERAS)
        (folder / "simulated.json").write_text(json.dumps(settings))
        write_poses(truth, velo_to_camera(invert(T[0]) @ T, _TR))


def simulate(root: str | Path, seed=0, sequences="all", scans=None, azimuth=1800,
             workers=None) -> Path:
    """Simulate an HDL-64E that drives through a city for each sequence, with exact ground truth.

    Writes ROOT in KITTI's odometry layout and returns it. seed: another one gives other cities;
    sequences: names, splits or "all"; scans: number per sequence (None: 170 for test and
    validation, which drive more than 115 m, and 320 for all others); azimuth: rays per beam and
    revolution; workers: processes (None: one per core).

    The same arguments give the same bytes, no matter which other sequences are made. A sequence
    appears when it is complete. One that is there already, made with the same settings, is left as
    it is. Raises ValueError for arguments out of range, or when ROOT holds such a sequence from
    elsewhere or with other settings, and OSError if a file cannot be written.
    """
    root, names = Path(root), expand_splits(sequences)
    for name, value, least in (("seed", seed, 0), ("scans", 1 if scans is None else scans, 1),
                               ("azimuth", azimuth, 16),
                               ("workers", 1 if workers is None else workers, 1)):
        if not isinstance(value, (int, np.integer)) or value < least:
            raise ValueError(f"{name} is {value} but must be a whole number, {least} or more.")
    for name in names:
        if not isinstance(name, str) or re.search(r"^\.|^$|[/\\\0]", name):
            raise ValueError(f"The sequence name {name!r} is no plain folder name: use one such "
                             "as '00'.")
    default = dict.fromkeys(SPLITS["test"] + SPLITS["validation"], 170)
    settings = {name: dict(city=CITY, seed=int(seed), scans=int(scans or default.get(name, 320)),
                           azimuth=int(azimuth)) for name in names}
    missing = [name for name in names if not _is_complete(root, name, settings[name])]
    for name in missing:
        try:
            _simulate_sequence(root, name, settings[name], workers or cores())
        except OSError:
            if not _is_complete(root, name, settings[name]):  # no other process was faster
                raise
    return root


# ------------------------------------------------------------------------------------------------
# The command line


def _command_line(argv):
    """Arguments of `simulate` and `raw`."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True, metavar="simulate | raw")

    add = commands.add_parser("simulate", help=(
        "make simulated drives, with ground truth")).add_argument
    add("dir", metavar="DIR", type=os.path.expanduser, help=(
        "folder to write, in KITTI's odometry layout"))
    add("--seed", type=int, metavar="N", default=0, help=(
        "random seed; another seed gives other cities (default: 0)"))
    add("--sequences", nargs="+", metavar="NN", default=["all"], help=(
        "names, or splits: train, test, validation, all (default: all)"))
    add("--scans", type=int, metavar="N", help=(
        "scans per sequence (default: 170 for test and validation, 320 for all others)"))
    add("--azimuth", type=int, metavar="N", default=1800, help=(
        "rays per beam and revolution (default: 1800)"))

    add = commands.add_parser("raw", help=(
        "convert a drive of KITTI's raw data, with ground truth")).add_argument
    add("drive", metavar="DRIVE", type=os.path.expanduser, help=(
        "unpacked folder such as 2011_09_26/2011_09_26_drive_0013_sync"))
    add("dir", metavar="ROOT", type=os.path.expanduser, help=(
        "folder to write, in KITTI's odometry layout"))
    return parser.parse_args(argv)


def main(argv=None):
    """Run the command line. Returns the exit code of `run_command`."""
    args = _command_line(argv)
    treat_sigterm_as_interrupt()

    def work():
        if args.command == "raw":
            parts = convert_raw(args.drive, args.dir)
            made = open_sequences(args.dir, list(parts))
        else:
            simulate(args.dir, args.seed, args.sequences, args.scans, args.azimuth)
            made = open_sequences(args.dir, args.sequences)
        print(f"{args.dir}: {len(made)} sequences, {sum(map(len, made)):,} scans")
        if args.command == "raw":
            for s, (first, last) in zip(made, parts.values()):
                print(f"{s.name}: scans {first} to {last}, {path_lengths(s.poses)[-1]:.1f} m")
            if len(made) > 1:
                print("The drive is split where scans or their GPS/IMU packets are missing.")

    return run_command("kitti.py", work, "complete sequences are kept, run it again for the rest")


if __name__ == "__main__":
    sys.exit(main())
