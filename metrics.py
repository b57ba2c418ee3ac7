"""Errors of a trajectory: KITTI's segment errors, errors per step, ATE and RPE. NumPy only, but
for pictures.

A trajectory is an array (n,4,4) of poses: T_0i maps points from frame i to frame 0, in metres. In
KITTI's pose files, frame i is the rectified left camera at scan i. The segment errors are those of
the KITTI devkit (devkit/cpp/evaluate_odometry.cpp), in the units of its leaderboard: E_t in
percent, E_r in degrees per metre.

    python metrics.py poses/00.txt results/00.txt
    python metrics.py poses results --plot results/plot.png
"""
import argparse
import codecs
import json
import os
import secrets
import sys
from contextlib import contextmanager
from pathlib import Path

import numpy as np

# ------------------------------------------------------------------------------------------------
# Errors

LENGTHS = np.arange(100, 801, 100)  # length of a segment [m]; devkit: lengths[]
START_EVERY = 10  # frames between the starts of two segments, one second; devkit: step_size
SEGMENT = np.dtype([
    ("first", int),  # frame in which the segment starts
    ("last", int),  # frame in which it ends
    ("length", float),  # nominal length [m]
    ("t_err", float),  # translation error [%]
    ("r_err", float),  # rotation error [deg/m]
])


def path_lengths(T):
    """Poses (n,4,4) -> length of the path up to each pose (n,) [m]; devkit: trajectoryDistances."""
    steps = np.diff(T[:, :3, 3], axis=0)  # (n-1,3)
    return np.concatenate([[0], np.cumsum(np.linalg.norm(steps, axis=1))])


def _same_shape(T_gt, T_est):
    """Both trajectories as float64 arrays. Raises ValueError if their shapes differ."""
    T_gt, T_est = np.asarray(T_gt, float), np.asarray(T_est, float)
    if T_gt.shape != T_est.shape:
        raise ValueError(f"true poses {T_gt.shape}, but estimated poses {T_est.shape}; both must "
                         "be (n,4,4) and cover the same scans")
    return T_gt, T_est


def segment_errors(T_gt: np.ndarray, T_est: np.ndarray) -> np.ndarray:
    """Errors of all KITTI segments of a sequence: eqs. 6 to 8, devkit: calcSequenceErrors.

    True and estimated poses (n,4,4), both in the same frame -> structured array (segments,) with
    fields first and last (frames), length [m], t_err [%], r_err [deg/m]. `kitti_errors` computes
    the means in eqs. 7 and 8.

    A segment starts at every 10th frame, as in the devkit. It ends at the first frame at which the
    true path since its start is longer than 100, 200, ... 800 m. Errors are divided by this nominal
    length, as in the devkit, and not by the straight distance of eqs. 7 and 8. The devkit sums the
    path in float32, which can shift `last` by one frame; here it is float64. Raises ValueError if
    the shapes differ.
    """
    T_gt, T_est = _same_shape(T_gt, T_est)
    path = path_lengths(T_gt)  # (n,)

    # Every length from every start
    starts = np.arange(0, len(path), START_EVERY)
    first, length = np.repeat(starts, len(LENGTHS)), np.tile(LENGTHS, len(starts))

    # The first frame beyond that length; drop segments that go beyond the end of the drive
    last = np.searchsorted(path, path[first] + length, side="right")
    complete = last < len(path)
    first, last, length = first[complete], last[complete], length[complete]  # (segments,)

    # Our error transform is the inverse of the paper's, as in the devkit. Both have the same length
    # of translation and the same angle of rotation.
    delta_gt = np.linalg.inv(T_gt[first]) @ T_gt[last]  # (segments,4,4)
    delta_est = np.linalg.inv(T_est[first]) @ T_est[last]  # (segments,4,4)
    error = np.linalg.inv(delta_est) @ delta_gt  # (segments,4,4)
    distance = np.linalg.norm(error[:, :3, 3], axis=1)  # (segments,) [m]
    trace = np.trace(error[:, :3, :3], axis1=1, axis2=2)  # (segments,)
    angle = np.arccos(np.clip((trace - 1) / 2, -1, 1))  # (segments,) eq. 6 [rad]

    out = np.empty(len(first), SEGMENT)
    out["first"], out["last"], out["length"] = first, last, length
    out["t_err"] = 100 * distance / length
    out["r_err"] = np.degrees(angle) / length
    return out


def kitti_errors(segments: list[np.ndarray]) -> tuple[float, float]:
    """E_t [%] and E_r [deg/m]: the means over the segments of all sequences, eqs. 7 and 8.

    segments: a list of `segment_errors`, one for each sequence. NaN without any segment.
    """
    pooled = np.concatenate([np.empty(0, SEGMENT), *segments])
    if not len(pooled):
        return float("nan"), float("nan")
    return float(pooled["t_err"].mean()), float(pooled["r_err"].mean())


def step_errors(T_gt: np.ndarray, T_est: np.ndarray) -> np.ndarray:
    """Error of every step from a frame to the next: evo's relative pose error with delta 1.

    True and estimated poses (n,4,4) -> (n-1,2): translation [m] and rotation angle [deg] of
    inv(motion_est) @ motion_gt, in the frame of the poses. Raises ValueError if the shapes differ.
    """
    T_gt, T_est = _same_shape(T_gt, T_est)
    motion_gt = np.linalg.inv(T_gt[:-1]) @ T_gt[1:]  # (n-1,4,4)
    motion_est = np.linalg.inv(T_est[:-1]) @ T_est[1:]  # (n-1,4,4)
    error = np.linalg.inv(motion_est) @ motion_gt  # (n-1,4,4)
    distance = np.linalg.norm(error[:, :3, 3], axis=1)  # (n-1,)

    # arctan2 is accurate for small angles. arccos of the trace is not: in pose files with seven
    # digits, rounding alone would appear as 0.03 degrees.
    R = error[:, :3, :3]
    twice_sine = np.linalg.norm(R - R.transpose(0, 2, 1), axis=(1, 2)) / 2**0.5  # (n-1,)
    twice_cosine = np.trace(R, axis1=1, axis2=2) - 1  # (n-1,)
    angle = np.degrees(np.arctan2(twice_sine, twice_cosine))  # (n-1,)
    return np.stack([distance, angle], axis=1)


def rmse(errors):
    """Root mean square of errors (n,), as evo computes it. NaN if there are none."""
    return float(np.sqrt(np.mean(np.square(errors)))) if len(errors) else float("nan")


def relative_to_first(T):
    """Poses (n,4,4) -> the same in the frame of the first one."""
    return np.linalg.inv(T[0]) @ T


def absolute_error(T_gt: np.ndarray, T_est: np.ndarray) -> float:
    """ATE [m]: RMSE of the positions, with the first poses aligned. Two trajectories (n,4,4).

    Raises ValueError if the shapes differ.
    """
    T_gt, T_est = map(relative_to_first, _same_shape(T_gt, T_est))
    return rmse(np.linalg.norm(T_gt[:, :3, 3] - T_est[:, :3, 3], axis=1))


# ------------------------------------------------------------------------------------------------
# Tables

COLUMNS = {  # key of a summary: header, digits after the point
    "segments": ("segments", 0), "E_t": ("E_t [%]", 3), "E_r": ("E_r [deg/m]", 5),
    "t_step_m": ("t step [m]", 4), "r_step_deg": ("r step [deg]", 4),
    "ate_m": ("ATE [m]", 3), "rpe_m": ("RPE [m]", 4), "rpe_deg": ("RPE [deg]", 4)}
UNITS = """\
E_t, E_r: KITTI devkit, mean over segments of 100 to 800 m of path. t step, r step: mean error per
step. ATE: RMSE with the first poses aligned, as `evo_ape kitti --align_origin`. RPE: RMSE over one
frame, as `evo_rpe kitti` prints by default; for RPE [deg] give -r angle_deg.
All in the frame of the files; KITTI's is the rectified left camera."""


def summary(segments, steps):
    """Mean errors over all sequences, as a dict. NaN where there is nothing to average.

    segments, steps: lists of `segment_errors` and of `step_errors`, one for each sequence.
    """
    E_t, E_r = kitti_errors(segments)
    pooled = np.concatenate([np.empty((0, 2)), *steps])
    t, r = pooled.mean(0).tolist() if len(pooled) else (float("nan"), float("nan"))
    return {"E_t": E_t, "E_r": E_r, "t_step_m": t, "r_step_deg": r,
            "segments": sum(map(len, segments))}


def by_length(segments):
    """A list of `segment_errors` -> {"100 m": summary, ...} for the lengths that occur."""
    pooled = np.concatenate([np.empty(0, SEGMENT), *segments])
    return {f"{length} m": summary([pooled[pooled["length"] == length]], [])
            for length in LENGTHS if length in pooled["length"]}


def table(rows):
    """Format a list of (name, summary) as text. A figure that is missing or NaN becomes "-"."""
    keys = [key for key in COLUMNS if any(key in s for _, s in rows)]
    lines = [["sequence", *(COLUMNS[key][0] for key in keys)]]
    for name, s in rows:
        figures = [f"{s.get(key, float('nan')):.{COLUMNS[key][1]}f}" for key in keys]
        lines.append([name, *("-" if figure == "nan" else figure for figure in figures)])
    widths = [max(map(len, column)) for column in zip(*lines)]
    return "\n".join("  ".join([name.ljust(widths[0]), *map(str.rjust, figures, widths[1:])])
                     for name, *figures in lines)


# ------------------------------------------------------------------------------------------------
# Files


@contextmanager
def naming(path):
    """Add the path to a system error of the block that names no file, such as that of a full disk.
    """
    try:
        yield
    except OSError as error:
        if error.errno and error.filename is None:  # our own errors have no errno
            raise OSError(f"{path}: could not be written ({error.strerror or error})") from None
        raise


@contextmanager
def replacing(path):
    """Yield a temporary path beside `path`, and move it to `path` if the block succeeds.

    So `path` never holds a half-written file. Raises OSError, naming the file, if writing fails or
    if `path` is not a regular file.
    """
    path = Path(path)
    if path.exists() and not path.is_file():
        raise OSError(f"{path}: is not a regular file, so it is not replaced; choose another name")
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    try:
        with naming(path):
            yield temporary
            os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_json(path, content):
    """Write lists, dicts and numbers as JSON, through a temporary file.

    NaN and infinity become null, since JSON has neither.
    """
    content = json.loads(json.dumps(content), parse_constant=lambda constant: None)
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1) + "\n", "utf-8", newline="\n")


def read_lines(path):
    """Read a text file: [(number, words), ...] of its lines, without the blank ones.

    A UTF-8 mark at the start is skipped. Raises OSError if the file cannot be read, and ValueError
    for UTF-16.
    """
    text = Path(path).read_bytes().removeprefix(codecs.BOM_UTF8)
    if text.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raise ValueError(f"{path}: is UTF-16 text; save it as UTF-8")
    lines = enumerate(text.decode("utf-8", "replace").splitlines(), 1)
    return [(number, line.split()) for number, line in lines if line.strip()]


COLUMN_HINTS = {8: "a line of 8 is that of a TUM file, t x y z qx qy qz qw",
                13: "a line of 13 may begin with a number or time, to be cut off",
                16: "a line of 16 is a whole 4x4 matrix, of which the last row is to be cut off"}


def parse(words, n):
    """The n numbers that a list of words spells (n,); NaN if they are not n numbers."""
    try:
        return np.array(words, dtype=float).reshape(n)
    except ValueError:
        return np.full(n, np.nan)


def read_poses(path: str | Path) -> np.ndarray:
    """Read a KITTI pose file.

    A line holds 12 numbers, the top three rows of a pose; blank lines are skipped. Returns (n,4,4)
    float64, translations in metres. Raises FileNotFoundError if there is no such file, and
    ValueError if it holds no pose, or a line that is not 12 finite numbers or not a rigid motion.
    """
    lines = read_lines(path)
    if not lines:
        raise ValueError(f"{path}: holds no pose; give a KITTI pose file, 12 numbers a line")
    T = np.tile(np.eye(4), (len(lines), 1, 1))  # (n,4,4)
    for pose, (number, words) in zip(T, lines):
        pose[:3] = parse(words, 12).reshape(3, 4)
        if not np.isfinite(pose).all():
            hint = COLUMN_HINTS.get(len(words), "correct the line")
            raise ValueError(f"{path}, line {number}: {len(words)} words, but a KITTI pose is 12 "
                             f"finite numbers; {hint}")
    rigid = is_rigid(T)
    if not rigid.all():
        raise ValueError(f"{path}: pose {np.argmin(rigid)} (counted from 0) is not a rigid motion; "
                         "its left 3x3 block must be a rotation")
    return T


def is_rigid(T):
    """Whether matrices T (...,3,4) or (...,4,4) are finite and hold a rotation -> (...) bool."""
    R = T[..., :3, :3]
    with np.errstate(all="ignore"):  # huge numbers overflow
        deviation = np.abs(R @ R.swapaxes(-1, -2) - np.eye(3)).max((-1, -2))
        is_rotation = (deviation < 1e-2) & (np.linalg.det(R) > 0)
    return np.isfinite(T).all((-1, -2)) & is_rotation


def write_poses(path: str | Path, T: np.ndarray) -> None:
    """Write poses (n,4,4) as a KITTI pose file, through a temporary file.

    Raises ValueError for another shape, and OSError if the file cannot be written.
    """
    if np.ndim(T) != 3 or np.shape(T)[1:] != (4, 4):
        raise ValueError(f"poses have the shape (n, 4, 4), not {np.shape(T)}")
    rows = np.asarray(T)[:, :3].reshape(-1, 12)
    with replacing(path) as temporary, open(temporary, "w", newline="\n") as file:
        np.savetxt(file, rows, fmt="%.9e")


# ------------------------------------------------------------------------------------------------
# Pictures

PICTURES = ".png", ".pdf", ".svg"


def new_figure(width, height):
    """An empty matplotlib figure of a size in inches. Raises ValueError without matplotlib."""
    try:
        from matplotlib.figure import Figure  # unlike pyplot, it needs no display
    except ImportError:
        raise ValueError("plotting needs matplotlib: pip install \".[plot]\"") from None
    return Figure(figsize=(width, height), layout="constrained")


def view_from_above(T: np.ndarray) -> tuple[np.ndarray, str, str]:
    """The view from above of poses (n,4,4): a matrix (2,3) and the labels of the two axes.

    The matrix maps positions to metres right and forward. The frame is inferred from the mean step:
    a vehicle moves along z in a camera's frame (x right, y down, z forward) and along x in a
    LiDAR's (x forward, y left, z up). Without any motion the frame is assumed to be the camera's,
    as in KITTI's pose files.
    """
    steps = np.linalg.inv(T[:-1]) @ T[1:]  # (n-1,4,4)
    x, y, z = steps[:, :3, 3].sum(axis=0)  # in the direction of the mean step
    if abs(z) >= np.hypot(x, y):
        return np.array([[1, 0, 0], [0, 0, 1]]), "camera x, right [m]", "camera z, forward [m]"
    return np.array([[0, -1, 0], [1, 0, 0]]), "LiDAR -y, right [m]", "LiDAR x, forward [m]"


def draw(path, trajectories):
    """Draw trajectories into a file, of a format in PICTURES.

    trajectories: {name: (T_gt or None, T_est)}, poses (n,4,4) in a camera's or a LiDAR's frame.
    Each name is a row: the path from above and, if there is any ground truth, KITTI's errors by
    segment length. Raises ValueError without matplotlib, and OSError if writing fails.
    """
    columns = 3 if any(T_gt is not None for T_gt, _ in trajectories.values()) else 1
    figure = new_figure(3.5 * columns, 3.1 * len(trajectories))
    rows = figure.subplots(len(trajectories), columns, squeeze=False)
    for (name, (T_gt, T_est)), (above, *errors) in zip(trajectories.items(), rows):
        name = name.encode("utf-8", "replace").decode()  # file names can hold any bytes
        lengths = by_length([] if T_gt is None else [segment_errors(T_gt, T_est)])
        T_gt, T_est = (T if T is None else relative_to_first(T) for T in (T_gt, T_est))
        view, right, forward = view_from_above(T_est if T_gt is None else T_gt)
        if T_gt is not None:
            above.plot(*view @ T_gt[:, :3, 3].T, color="0.65", lw=4, label="truth")
        above.plot(*view @ T_est[:, :3, 3].T, color="black", lw=1.2, label="estimate")
        above.plot(0, 0, "ko", ms=5)
        above.set_title(f"{name} from above, from the dot", parse_math=False)  # a $ is a $
        above.set(xlabel=right, ylabel=forward, aspect="equal", adjustable="datalim")
        above.legend(frameon=False)
        for axis, key, unit in zip(errors, ("E_t", "E_r"), ("%", "deg/m")):
            values = [s[key] for s in lengths.values()]
            axis.plot([int(length.split()[0]) for length in lengths], values, "ko-")
            if not lengths:
                axis.text(450, 0.5, "no segment", ha="center")
            axis.set_title(f"{name}: {key} by length", parse_math=False)
            axis.set(xlabel="length of the segments [m]", ylabel=f"{key} [{unit}]", xlim=(50, 850),
                     ylim=(0, 1.15 * max(values, default=0) or 1))
    for axis in rows.flat:
        axis.grid(color="0.9")
    with replacing(path) as temporary:
        figure.savefig(temporary, format=Path(path).suffix[1:], dpi=100)


# ------------------------------------------------------------------------------------------------
# The command line


def run_command(name, work, advice="run it again"):
    """Call work(). Returns the exit code: 0, 2 for an error, 130 when interrupted.

    An error is printed in one line on stderr. advice: what to do after an interruption.
    """
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):  # print characters that a terminal lacks as escapes
            stream.reconfigure(errors="backslashreplace")
    try:
        work()
        print(end="", flush=True)  # a closed pipe raises here and not at exit
        return 0
    except KeyboardInterrupt as interrupt:
        print(f"\n{name}: interrupted; {str(interrupt) or advice}", file=sys.stderr)
        return 130
    except BrokenPipeError:
        sys.stdout = open(os.devnull, "w")  # otherwise Python complains at exit
        print(f"{name}: standard output was closed; {advice}", file=sys.stderr)
    except (ValueError, OSError) as error:
        print(f"{name}: {' '.join(str(error).split())}", file=sys.stderr)
    return 2


def _pairs_of_files(gt, est):
    """Pair two pose files, or those of two folders: {sequence: (true, estimated) pose file}."""
    if gt.is_dir() != est.is_dir():
        raise ValueError(f"{gt} and {est}: one is a folder and the other is not; give two pose "
                         "files, or two folders of NN.txt")
    if not gt.is_dir():
        return {gt.stem: (gt, est)}
    pairs = {path.stem: (gt / path.name, path) for path in sorted(est.glob("[!.]*.txt"))
             if (gt / path.name).is_file()}
    if not pairs:
        raise FileNotFoundError(f"{est}: holds no NN.txt that is also in {gt}; give two folders "
                                "with pose files of the same names")
    return pairs


def _compare(gt, est, picture=None):
    """Compare pose files or folders. Returns the text to print; draws the picture, if any."""
    pairs = _pairs_of_files(gt, est)
    if picture and (picture.suffix not in PICTURES
                    or picture.resolve() in (gt.resolve(), est.resolve())):
        raise ValueError(f"--plot {picture}: give the name of a new {', '.join(PICTURES)} file")
    trajectories, segments, steps, rows = {}, [], [], []
    for name, (gt, est) in pairs.items():
        T_gt, T_est = trajectories[name] = read_poses(gt), read_poses(est)
        if len(T_gt) != len(T_est):
            raise ValueError(f"{est}: {len(T_est)} poses, but {gt} has {len(T_gt)}; both must "
                             "cover the same scans")
        segments.append(segment_errors(T_gt, T_est))
        steps.append(step_errors(T_gt, T_est))
        evo = {"ate_m": absolute_error(T_gt, T_est), "rpe_m": rmse(steps[-1][:, 0]),
               "rpe_deg": rmse(steps[-1][:, 1])}
        rows.append((name, summary(segments[-1:], steps[-1:]) | evo))
    if len(rows) > 1:
        rows.append(("all", summary(segments, steps)))
    rows += by_length(segments).items()
    if any(view_from_above(T_gt)[1] != view_from_above(T_est)[1] for T_gt, T_est in
           trajectories.values()):
        print("the trajectories seem to be in different frames, a camera's and a LiDAR's; "
              "kitti.velo_to_camera converts them", file=sys.stderr)
    if picture:
        draw(picture, trajectories)
    return "\n".join([table(rows), UNITS, *([str(picture)] if picture else [])])


def main(argv=None):
    """Run the command line. Returns the exit code of `run_command`."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    path = dict(type=lambda text: Path(text).expanduser())
    parser.add_argument("gt", metavar="GT", **path, help=(
        "ground truth: a pose file, or a folder of NN.txt"))
    parser.add_argument("est", metavar="EST", **path, help=(
        "estimate: a pose file, or a folder of NN.txt"))
    parser.add_argument("--plot", metavar="FILE", **path, help=(
        "draw the paths and the errors by segment length into a .png, .pdf or .svg file; "
        "needs matplotlib"))
    args = parser.parse_args(argv)
    return run_command("metrics.py", lambda: print(_compare(args.gt, args.est, args.plot)))


if __name__ == "__main__":
    sys.exit(main())
