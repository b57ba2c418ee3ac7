"""How good is a trajectory? KITTI's segment errors, errors per step, ATE and RPE. NumPy only.

A trajectory is an array (n,4,4): T_0i maps points of frame i into frame 0. In KITTI's pose files, frame i is the rectified
left camera of scan i. The numbers are those of the KITTI devkit (devkit/cpp/evaluate_odometry.cpp), in the units of its
leaderboard: E_t in percent, E_r in degrees per metre.

    python metrics.py poses/00.txt results/00.txt
    python metrics.py poses results --plot results/plot.png
"""
import argparse, codecs, glob, json, os, platform, shutil, sys
from contextlib import contextmanager
from pathlib import Path

import numpy as np

LENGTHS = np.arange(100, 801, 100)      # m of path, devkit: lengths[]
START_EVERY = 10                        # frames, devkit: step_size (one second)
SEGMENT = np.dtype([("first", int), ("last", int), ("length", float), ("t_err", float), ("r_err", float)])


def temporary_beside(path):
    """A path beside `path` for this process to write to. What processes of this machine that are no more left there is removed."""
    prefix = f".{path.name}.{platform.node()}."
    for left in path.parent.glob(glob.escape(prefix) + "*") if os.name == "posix" else ():      # elsewhere signal 0 is no question
        try:
            os.kill(int(left.name[len(prefix):]), 0)
        except (ProcessLookupError, OverflowError):         # it runs no more
            shutil.rmtree(left, ignore_errors=True) if left.is_dir() else left.unlink(missing_ok=True)
        except (PermissionError, ValueError):               # another user's; not ours at all
            pass
    return path.with_name(prefix + str(os.getpid()))


@contextmanager
def replacing(path):
    """Yields a temporary path beside `path`, moved onto it when the block ends well: never a half-written file.

    OSError, naming the file, when that fails, or when `path` is something else than a regular file."""
    path = Path(path)
    if path.exists() and not path.is_file():
        raise OSError(f"{path}: is not a regular file, so it is not replaced; choose another name")
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = temporary_beside(path)
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        if error.filename is None and error.strerror:      # as when the disk is full
            raise OSError(error.errno, error.strerror, str(path)) from None
        raise
    finally:
        temporary.unlink(missing_ok=True)


def write_json(path, content):
    """Write lists, dicts and numbers as JSON, through a temporary file; NaN, which JSON has not, becomes null."""
    plain = json.loads(json.dumps(content), parse_constant=lambda nan: None)
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(plain, indent=1) + "\n", encoding="utf-8", newline="\n")


def read_poses(path: str | Path) -> np.ndarray:
    """A KITTI pose file, 12 numbers a row (the top three rows of a 4x4), as (n,4,4) float64. ValueError, FileNotFoundError."""
    text = Path(path).read_bytes().removeprefix(codecs.BOM_UTF8)
    if text.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raise ValueError(f"{path}: is UTF-16 text; save it as UTF-8")
    rows = [(number, line.split()) for number, line in enumerate(text.splitlines(), 1) if line.strip()]
    if not rows:
        raise ValueError(f"{path}: holds no pose")
    T = np.tile(np.eye(4), (len(rows), 1, 1))                                       # (n,4,4)
    for pose, (number, words) in zip(T, rows):
        try:
            pose[:3] = np.array(words, float).reshape(3, 4)
        except ValueError:
            pose[:] = np.nan
        if not np.isfinite(pose).all():
            raise ValueError(f"{path}, line {number}: {len(words)} words, but a KITTI pose is 12 finite numbers")
    R = T[:, :3, :3]
    with np.errstate(all="ignore"):                         # of absurd numbers
        rigid = (np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max((1, 2)) < 1e-2) & (np.linalg.det(R) > 0)
    if not rigid.all():
        raise ValueError(f"{path}: pose {np.argmin(rigid)} (from 0) is no rigid motion: its left 3x3 block is not a rotation")
    return T


def write_poses(path: str | Path, T: np.ndarray) -> None:
    """Write (n,4,4) poses as a KITTI pose file, through a temporary file."""
    with replacing(path) as temporary, open(temporary, "w", newline="\n") as file:
        np.savetxt(file, np.asarray(T)[:, :3].reshape(-1, 12), fmt="%.9e")


def _same_length(T_gt, T_est):
    T_gt, T_est = np.asarray(T_gt, float), np.asarray(T_est, float)
    if T_gt.shape != T_est.shape:
        raise ValueError(f"true poses {T_gt.shape} but estimated ones {T_est.shape}: both must be (n,4,4) and cover the same scans")
    return T_gt, T_est


def path_lengths(T):
    """Path driven until each pose (n,), in metres (devkit: trajectoryDistances)."""
    return np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1))])


def segment_errors(T_gt: np.ndarray, T_est: np.ndarray) -> np.ndarray:
    """Errors of all KITTI segments of one sequence (paper: eqs. 6 to 8, whose means `kitti_errors` takes; devkit: calcSequenceErrors).

    (n,4,4), (n,4,4) -> structured array with fields first, last (frames), length [m], t_err [%], r_err [deg/m].
    A segment starts at every 10th frame and ends at the first frame whose path from there is strictly longer than 100, 200,
    ... 800 m of true path; errors are divided by that nominal length, not by the straight distance that eqs. 7 and 8 name. The devkit
    sums the path in float32, which may move `last` by a frame; here it is float64. ValueError when the lengths differ.
    """
    T_gt, T_est = _same_length(T_gt, T_est)
    path = path_lengths(T_gt)
    first, length = (a.ravel() for a in np.meshgrid(np.arange(0, len(path), START_EVERY), LENGTHS, indexing="ij"))
    last = np.searchsorted(path, path[first] + length, side="right")
    first, last, length = (a[last < len(path)] for a in (first, last, length))
    delta_gt = np.linalg.inv(T_gt[first]) @ T_gt[last]
    delta_est = np.linalg.inv(T_est[first]) @ T_est[last]
    error = np.linalg.inv(delta_est) @ delta_gt     # (segments,4,4); the inverse of the paper's, as in the devkit: same length and angle
    cosine = (np.trace(error[:, :3, :3], axis1=1, axis2=2) - 1) / 2                 # eq. 6; arccos, as in the devkit
    out = np.empty(len(first), SEGMENT)
    out["first"], out["last"], out["length"] = first, last, length
    out["t_err"] = 100 * np.linalg.norm(error[:, :3, 3], axis=1) / length
    out["r_err"] = np.degrees(np.arccos(np.clip(cosine, -1, 1))) / length
    return out


def kitti_errors(segments: list[np.ndarray]) -> tuple[float, float]:
    """List of `segment_errors`, one a sequence -> (E_t [%], E_r [deg/m]), the mean over all their segments; NaN without any."""
    pooled = np.concatenate([np.empty(0, SEGMENT), *segments])
    return (float(pooled["t_err"].mean()), float(pooled["r_err"].mean())) if len(pooled) else (float("nan"),) * 2


def step_errors(T_gt: np.ndarray, T_est: np.ndarray) -> np.ndarray:
    """(n,4,4), (n,4,4) -> (n-1,2): length [m] and angle [deg] of inv(T_est) @ T_gt of each step, in the frame of the poses."""
    T_gt, T_est = _same_length(T_gt, T_est)
    motion_gt, motion_est = (np.linalg.inv(T[:-1]) @ T[1:] for T in (T_gt, T_est))
    error = np.linalg.inv(motion_est) @ motion_gt
    R = error[:, :3, :3]
    # atan2 and not arccos of the trace, which between nearly equal rotations of seven digits makes 0.03 deg out of rounding
    sine, cosine = np.linalg.norm(R - R.transpose(0, 2, 1), axis=(1, 2)) / 2 ** 0.5, np.trace(R, axis1=1, axis2=2) - 1      # twice both
    return np.stack([np.linalg.norm(error[:, :3, 3], axis=1), np.degrees(np.arctan2(sine, cosine))], 1)


def absolute_errors(T_gt: np.ndarray, T_est: np.ndarray) -> np.ndarray:
    """(n,) distances [m] between true and estimated positions, both starting where the files say: nothing is aligned."""
    T_gt, T_est = _same_length(T_gt, T_est)
    return np.linalg.norm(T_gt[:, :3, 3] - T_est[:, :3, 3], axis=1)


def rmse(errors):
    """Root of the mean square, the figure evo prints as rmse; NaN of nothing."""
    return float(np.sqrt(np.mean(np.square(errors)))) if len(errors) else float("nan")


def table(header, rows):
    """Lines of right-aligned columns, the first one left-aligned; floats that are NaN as '-'."""
    cells = [list(header)] + [["-" if str(c).strip() == "nan" else str(c) for c in row] for row in rows]
    widths = [max(len(row[i]) for row in cells) for i in range(len(header))]
    return "\n".join("  ".join(c.rjust(w) if i else c.ljust(w) for i, (c, w) in enumerate(zip(row, widths))) for row in cells)


HEADER = ["sequence", "segments", "E_t [%]", "E_r [deg/m]", "t step [m]", "r step [deg]"]


def summary(segments, steps):
    """Lists of `segment_errors` and `step_errors`, one a sequence -> dict of their pooled means, NaN where there is nothing."""
    E_t, E_r = kitti_errors(segments)
    steps = np.concatenate([np.empty((0, 2)), *steps])
    t, r = steps.mean(0).tolist() if len(steps) else (float("nan"),) * 2
    return {"E_t": E_t, "E_r": E_r, "t_step_m": t, "r_step_deg": r, "segments": sum(map(len, segments))}


def by_length(segments):
    """List of `segment_errors` -> {"100 m": summary, ...} of the lengths there are."""
    pooled = np.concatenate([np.empty(0, SEGMENT), *segments])
    return {f"{m} m": summary([pooled[pooled["length"] == m]], []) for m in LENGTHS if m in pooled["length"]}


def row(name, s):
    """A `summary` as a row of a table under HEADER."""
    return [name, s["segments"], f"{s['E_t']:.3f}", f"{s['E_r']:.5f}", f"{s['t_step_m']:.4f}", f"{s['r_step_deg']:.4f}"]


def picture(width, height):
    """An empty figure of so many inches. ValueError without matplotlib."""
    try:
        from matplotlib.figure import Figure                # without pyplot no display is needed
    except ImportError:
        raise ValueError("a picture needs matplotlib: pip install \".[plot]\"") from None
    return Figure(figsize=(width, height), layout="constrained")


def view_from_above(T: np.ndarray) -> tuple[np.ndarray, str, str]:
    """How to draw poses (n,4,4) from above: a matrix (2,3) and the labels of the two axes.

    The matrix maps positions to metres right and forward. The frame is found from the mean step,
    each step in its own frame: a vehicle moves along z in a camera's frame (x right, y down,
    z forward) and along x in a LiDAR's (x forward, y left, z up). Without any motion the frame
    is taken to be the camera's, as in KITTI's pose files.
    """
    steps = np.linalg.inv(T[:-1]) @ T[1:]
    x, y, z = steps[:, :3, 3].sum(axis=0)               # the direction of the mean
    if abs(z) >= np.hypot(x, y):
        return np.array([[1, 0, 0], [0, 0, 1]]), "camera x, right [m]", "camera z, forward [m]"
    return np.array([[0, -1, 0], [1, 0, 0]]), "LiDAR -y, right [m]", "LiDAR x, forward [m]"


def draw(path, trajectories):
    """{name: (T_gt or None, T_est)}, poses (n,4,4) in a camera's or a LiDAR's frame -> a PNG.

    Each name is a row: the path from above and, if there is any ground truth, KITTI's errors by the
    length of the segments. Raises ValueError without matplotlib.
    """
    columns = 3 if any(T_gt is not None for T_gt, _ in trajectories.values()) else 1
    figure = picture(3.5 * columns, 3.1 * len(trajectories))
    rows = figure.subplots(len(trajectories), columns, squeeze=False)
    for (name, (T_gt, T_est)), (above, *errors) in zip(trajectories.items(), rows):
        view, right, forward = view_from_above(T_est if T_gt is None else T_gt)
        for T, style in (T_gt, dict(color="0.65", lw=4, label="truth")), (T_est, dict(color="black", lw=1.2, label="estimate")):
            if T is not None:
                above.plot(*view @ T[:, :3, 3].T, **style)
        above.plot(0, 0, "ko", ms=5)
        above.set(title=f"{name} from above, from the dot", xlabel=right, ylabel=forward,
                  aspect="equal", adjustable="datalim")
        above.legend(frameon=False)
        lengths = by_length([] if T_gt is None else [segment_errors(T_gt, T_est)])
        for axis, error, unit in zip(errors, ("E_t", "E_r"), ("%", "deg/m")):
            axis.plot([int(m.split()[0]) for m in lengths], [s[error] for s in lengths.values()], "ko-")
            axis.text(450, 0.5, "no segment" * (not lengths), ha="center")
            axis.set(title=f"{name}: {error} by length", xlabel="length of the segments [m]",
                     ylabel=f"{error} [{unit}]", xlim=(50, 850), ylim=(0, 1.15 * max((s[error] for s in lengths.values()), default=0) or 1))
    for axis in rows.flat:
        axis.grid(color="0.9")
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=100)


def _pairs_of_files(gt, est):
    if gt.is_dir() != est.is_dir():
        raise ValueError(f"{gt} and {est}: give two pose files or two folders of NN.txt, not one of each")
    if not gt.is_dir():
        return {gt.stem: (gt, est)}
    pairs = {path.stem: (gt / path.name, path) for path in sorted(est.glob("*.txt")) if (gt / path.name).is_file()}
    if not pairs:
        raise FileNotFoundError(f"{est}: holds no NN.txt that {gt} holds as well")
    return pairs


def main(argv=None):
    """The command line -> exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("gt", metavar="GT", type=Path, help="ground truth: a pose file, or a folder of NN.txt")
    parser.add_argument("est", metavar="EST", type=Path, help="estimate: likewise")
    parser.add_argument("--plot", metavar="PNG", type=Path, help="draw the paths and the errors by length; needs matplotlib")
    args = parser.parse_args(argv)
    rows, segments, steps, trajectories = [], [], [], {}
    try:
        pairs = _pairs_of_files(args.gt, args.est)
        inputs = {path.resolve() for pair in pairs.values() for path in pair}
        if args.plot and args.plot.resolve() in inputs:
            raise ValueError(f"--plot {args.plot}: is one of the pose files; choose another name")
        for name, (gt, est) in pairs.items():
            T_gt, T_est = trajectories[name] = read_poses(gt), read_poses(est)
            if len(T_gt) != len(T_est):
                raise ValueError(f"{est}: {len(T_est)} poses, but {gt} has {len(T_gt)}; both must cover the same scans")
            segments.append(segment_errors(T_gt, T_est))
            steps.append(step_errors(T_gt, T_est))
            ate, rpe_m, rpe_deg = map(rmse, (absolute_errors(T_gt, T_est), *steps[-1].T))
            rows.append(row(name, summary(segments[-1:], steps[-1:])) + [f"{ate:.3f}", f"{rpe_m:.4f}", f"{rpe_deg:.4f}"])
        if args.plot:
            draw(args.plot, trajectories)
    except (ValueError, OSError) as error:
        print(f"metrics.py: {error}", file=sys.stderr)
        return 2
    blank = ["-"] * 3
    if len(rows) > 1:
        rows.append(row("all", summary(segments, steps)) + blank)
    rows += [row(length, s) + blank for length, s in by_length(segments).items()]
    print(table([*HEADER, "ATE [m]", "RPE [m]", "RPE [deg]"], rows))
    print("E_t, E_r: KITTI devkit, mean over segments of 100..800 m of path. t step, r step: mean error of a step. ATE, RPE: rmse as"
          "\nevo_ape kitti / evo_rpe kitti print it without flags (no alignment, delta one frame; degrees with -r angle_deg)."
          "\nAll in the frame of the files: KITTI's is the rectified left camera." + (f"\n{args.plot}" if args.plot else ""))
    return 0


if __name__ == "__main__":
    sys.exit(main())
