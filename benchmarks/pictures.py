"""Pictures for the README. Needs matplotlib: pip install ".[plot]"

    python benchmarks/pictures.py method docs/method.png            # what the network sees of two simulated scans
    python benchmarks/pictures.py method docs/method.png --data ROOT --sequence 00 --scan 100
    python benchmarks/pictures.py curve runs/A/curve.png runs/A runs/B ...      # loss by epoch
    python d3dlo.py eval --data data/full --sequences 04 05 06 --refine 2 --plot    # its plot.png is docs/trajectory.png
"""
import argparse
import re
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import d3dlo
import kitti
import metrics

GREY, BLACK = dict(color="0.6", s=0.3, linewidths=0), dict(color="black", s=4, linewidths=0)


def window(axis, centre, half, title):
    """A square of 2 * half metres, in the Velodyne frame, x up as in driving."""
    axis.set(title=title, xlabel="y [m]", ylabel="x [m]", aspect="equal", xlim=(centre[1] + half, centre[1] - half), ylim=(centre[0] - half, centre[0] + half))


def method(root, name, i):
    """Centroids of a scan, one ball of SA1 and of SA2, the neighbours of the flow embedding."""
    config, s = d3dlo.Config(), kitti.Sequence(root, name)
    scan, (p, q) = s.scan(i), (d3dlo.scan_geometry(s.scan(j), config) for j in (i, i + 1))
    xyz, n2, n3 = p["xyz"], config.sa2.n_fps, config.sa3.n_fps
    distance = np.linalg.norm(xyz[:n2, :2], axis=1)
    one = int(np.argmin(np.abs(distance - 12) + 10 * (xyz[:n2, 2] < -1)))      # something upright, 12 m away
    figure = metrics.picture(14, 3.9)
    all_, ball, wide, flow = figure.subplots(1, 4)
    all_.scatter(scan[:, 1], scan[:, 0], **GREY)
    all_.scatter(xyz[:, 1], xyz[:, 0], **BLACK)
    window(all_, (0, 0), 45, f"a scan, its {len(xyz):,} centroids")
    for axis, r, members, points, label in (
            (ball, config.sa1.r, p["group"][one][:, :3] + xyz[one], scan, f"SA1: {config.sa1.n_n} of the points within {config.sa1.r:.0f} m"),
            (wide, config.sa2.r, xyz[p["idx2"][one]], xyz, f"SA2: centroids within {config.sa2.r:.0f} m")):
        axis.scatter(points[:, 1], points[:, 0], color="0.7", s=3, linewidths=0)
        axis.scatter(members[:, 1], members[:, 0], color="black", s=14, linewidths=0)
        turn = np.linspace(0, 2 * np.pi, 100)
        axis.plot(xyz[one, 1] + r * np.sin(turn), xyz[one, 0] + r * np.cos(turn), color="0.4", lw=0.8)
        axis.plot(xyz[one, 1], xyz[one, 0], "k+", ms=12)
        window(axis, xyz[one], 1.6 * r, label)
    near = q["xyz"][d3dlo.group_knn(q["xyz"], xyz[[one]], config.fe.n_n)[0]]
    flow.scatter(q["xyz"][:, 1], q["xyz"][:, 0], facecolors="none", edgecolors="0.5", s=14, linewidths=0.8, label="Q")
    flow.scatter(xyz[:, 1], xyz[:, 0], label="P", **BLACK | dict(s=10))
    for y in near:
        flow.plot([xyz[one, 1], y[1]], [xyz[one, 0], y[0]], color="0.2", lw=0.7)
    flow.legend(frameon=False, loc="upper right")
    window(flow, xyz[one], 1.3 * np.abs(near - xyz[one])[:, :2].max(), f"FE: {config.fe.n_n} neighbours in Q")
    return figure


def curve(runs):
    """The loss of each epoch, from the trainings' logs."""
    figure = metrics.picture(6, 3.5)
    axis = figure.subplots()
    for run, style in zip(runs, ("k-", "k--", "k:", "k-.") * len(runs)):
        losses = re.findall(r"^epoch (\d+)/\d+: loss ([\d.]+)", (run / "log.txt").read_text(encoding="utf-8"), re.M)
        axis.plot(*np.array(losses, float).reshape(-1, 2).T, style, label=run.name)
    axis.set(xlabel="epoch", ylabel="mean loss, eq. 2: m and degrees alike", yscale="log")
    axis.legend(frameon=False)
    axis.grid(color="0.9", which="both")
    return figure


def main():
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    m = commands.add_parser("method")
    m.add_argument("picture", type=Path)
    m.add_argument("--data", metavar="ROOT", help="folder in KITTI odometry layout (default: the simulated city)")
    m.add_argument("--sequence", default="03", metavar="NN")
    m.add_argument("--scan", type=int, default=60, metavar="N")
    c = commands.add_parser("curve")
    c.add_argument("picture", type=Path)
    c.add_argument("runs", nargs="+", type=Path, metavar="RUN")
    args = parser.parse_args()
    try:
        if args.command == "method":
            figure = method(args.data or kitti.simulate(d3dlo.SIMULATED, sequences=[args.sequence]), args.sequence, args.scan)
        else:
            figure = curve(args.runs)
        with metrics.replacing(args.picture) as temporary:
            figure.savefig(temporary, format="png", dpi=100)
    except (ValueError, OSError) as error:
        parser.error(str(error))
    print(args.picture)


if __name__ == "__main__":
    main()
