"""Pictures for the documentation. Needs matplotlib: pip install ".[plot]"

    python benchmarks/pictures.py method docs/method.png  # sampling and grouping of two scans
    python benchmarks/pictures.py method docs/method.png --data ROOT --sequence 00 --scan 100
    python benchmarks/pictures.py curve curve.png runs/A runs/B  # training loss by epoch

docs/trajectory.png is the plot.png of

    python d3dlo.py eval --data data/full --sequences 04 05 06 --refine 2 --plot
"""
import argparse
import itertools
import re
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import d3dlo
import kitti
import metrics


def scatter(axis, points, size, color, **style):
    """Points (n,3) from above, the x axis up: the vehicle drives upwards."""
    axis.scatter(points[:, 1], points[:, 0], s=size, color=color, linewidths=0, **style)


def window(axis, centre, half, title):
    """Show a square of 2 * half metres around centre, in the Velodyne frame."""
    x, y = centre[:2]
    axis.set(title=title, xlabel="y [m]", ylabel="x [m]", aspect="equal",
             xlim=(y + half, y - half), ylim=(x - half, x + half))


def draw_ball(axis, points, neighbours, centroid, r, title):
    """The points around a centroid, its neighbours among them, and the ball of radius r."""
    scatter(axis, points, 3, "0.7")
    scatter(axis, neighbours, 14, "black")
    turn = np.linspace(0, 2 * np.pi, 100)
    axis.plot(centroid[1] + r * np.sin(turn), centroid[0] + r * np.cos(turn), color="0.4", lw=0.8)
    axis.plot(centroid[1], centroid[0], "k+", ms=12)
    window(axis, centroid, 1.6 * r, title)


def draw_flow(axis, xyz_p, xyz_q, centroid, k):
    """A centroid of P and its k neighbours among the centroids of Q."""
    neighbours = xyz_q[d3dlo.group_knn(xyz_q, centroid[None], k)[0]]
    axis.scatter(xyz_q[:, 1], xyz_q[:, 0], s=14, facecolors="none", edgecolors="0.5",
                 linewidths=0.8, label="Q")
    scatter(axis, xyz_p, 10, "black", label="P")
    for y in neighbours:
        axis.plot([centroid[1], y[1]], [centroid[0], y[0]], color="0.2", lw=0.7)
    axis.legend(frameon=False, loc="upper right")
    half = 1.3 * np.abs(neighbours - centroid)[:, :2].max()
    window(axis, centroid, half, f"FE: {k} neighbours in Q")


def method(root, name, i):
    """Centroids of scan i, a ball of SA1 and of SA2, and the neighbours of the flow embedding."""
    config = d3dlo.load_weights()[0].config
    s = kitti.Sequence(root, name)
    if not 0 <= i < len(s) - 1:
        raise ValueError(f"sequence {name} has {len(s)} scans; --scan must be 0 to {len(s) - 2}")
    scan = s.scan(i)
    p, q = d3dlo.scan_geometry(scan, config), d3dlo.scan_geometry(s.scan(i + 1), config)
    xyz, sa1, sa2 = p["xyz"], config.sa1, config.sa2
    ranges = np.linalg.norm(xyz[:sa2.n_fps, :2], axis=1)
    on_ground = xyz[:sa2.n_fps, 2] < -1
    j = np.argmin(np.abs(ranges - 12) + 10 * on_ground)  # something upright, about 12 m away

    figure = metrics.picture(14, 3.9)
    whole, ball1, ball2, flow = figure.subplots(1, 4)
    scatter(whole, scan, 0.3, "0.6")
    scatter(whole, xyz, 4, "black")
    window(whole, (0, 0), 45, f"a scan, its {len(xyz):,} centroids")
    neighbours = xyz[j] + p["group"][j][:, 1:]  # group holds intensity and x_i - x'_j
    draw_ball(ball1, scan, neighbours, xyz[j], sa1.r,
              f"SA1: {sa1.n_n} of the points within {sa1.r:.0f} m")
    draw_ball(ball2, xyz, xyz[p["idx2"][j]], xyz[j], sa2.r,
              f"SA2: centroids within {sa2.r:.0f} m")
    draw_flow(flow, xyz, q["xyz"], xyz[j], config.fe.n_n)
    return figure


def curve(runs):
    """The mean training loss of each epoch, from the logs of training runs."""
    figure = metrics.picture(6, 3.5)
    axis = figure.subplots()
    line = re.compile(r"^epoch (\d+)/\d+: loss ([\d.]+)", re.M)
    for run, style in zip(runs, itertools.cycle(("k-", "k--", "k:", "k-."))):
        epochs = line.findall((run / "log.txt").read_text(encoding="utf-8"))
        axis.plot(*np.array(epochs, float).reshape(-1, 2).T, style, label=run.name)
    axis.set(xlabel="epoch", ylabel="mean loss, eq. 2", yscale="log")
    axis.legend(frameon=False)
    axis.grid(color="0.9", which="both")
    return figure


def main():
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    m = commands.add_parser("method", help="sampling and grouping of two scans")
    m.add_argument("picture", type=Path)
    m.add_argument("--data", metavar="ROOT", help=(
        "folder in KITTI odometry layout (default: the simulated city)"))
    m.add_argument("--sequence", default="03", metavar="NN", help="default: 03")
    m.add_argument("--scan", type=int, default=60, metavar="N", help="default: 60")
    c = commands.add_parser("curve", help="training loss by epoch")
    c.add_argument("picture", type=Path)
    c.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="folder of a training run")
    args = parser.parse_args()
    try:
        if args.command == "method":
            root = args.data or kitti.simulate(d3dlo.SIMULATED, sequences=[args.sequence])
            figure = method(root, args.sequence, args.scan)
        else:
            figure = curve(args.runs)
        with metrics.replacing(args.picture) as temporary:
            figure.savefig(temporary, format="png", dpi=100)
    except (ValueError, OSError) as error:
        parser.error(str(error))
    print(args.picture)


if __name__ == "__main__":
    main()
