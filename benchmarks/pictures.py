"""Pictures for the documentation. Needs matplotlib: pip install ".[plot]"

    python benchmarks/pictures.py network docs/network.png  # Fig. 1 with shapes and parameters
    python benchmarks/pictures.py method docs/method.png  # sampling and grouping of two scans
    python benchmarks/pictures.py method docs/method.png --data ROOT --sequence 00 --scan 100
    python benchmarks/pictures.py curve docs/curve.png runs/A  # loss by epoch
    python benchmarks/pictures.py table2 docs/table2.png runs/experiments

Trajectories and errors come from two evaluations of the same data, plain and refined:

    python d3dlo.py eval --data ROOT --out P && python d3dlo.py eval --data ROOT --refine 3 --out R
    python benchmarks/pictures.py paths docs/paths.png ROOT P R --sequences 03 04 06

The errors of KISS-ICP on the same data come from benchmarks/classical.py:

    python benchmarks/classical.py ROOT K
    python benchmarks/pictures.py steps docs/steps.png P R K  # real drives
"""
import argparse
import json
import re
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from experiments import PAPER_2, row_of_table_2

import d3dlo
import kitti
import metrics


def scatter(axis, points, size, color, **style):
    """Draw points (n,3) from above, with the x axis up: the vehicle drives upwards."""
    axis.scatter(points[:, 1], points[:, 0], s=size, color=color, linewidths=0, **style)


def window(axis, centre, half, title):
    """Show a square of 2 * half metres around centre, in the Velodyne frame."""
    x, y = centre[:2]
    axis.set(title=title, xlabel="y [m]", ylabel="x [m]", aspect="equal",
             xlim=(y + half, y - half), ylim=(x - half, x + half))


def draw_ball(axis, points, neighbours, centroid, r, title):
    """Draw the points around a centroid, its neighbours, and the ball of radius r."""
    scatter(axis, points, 3, "0.7")
    scatter(axis, neighbours, 14, "black")
    turn = np.linspace(0, 2 * np.pi, 100)
    axis.plot(centroid[1] + r * np.sin(turn), centroid[0] + r * np.cos(turn), color="0.4", lw=0.8)
    axis.plot(centroid[1], centroid[0], "k+", ms=12)
    window(axis, centroid, 1.6 * r, title)


def draw_flow(axis, xyz_p, xyz_q, centroid, k):
    """Draw a centroid of P and its k neighbours among the centroids of Q."""
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
    """Draw the centroids of scan i, a ball of SA1 and of SA2, and a group of the flow embedding."""
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

    figure = metrics.new_figure(14, 3.9)
    whole, ball1, ball2, flow = figure.subplots(1, 4)
    scatter(whole, scan, 0.3, "0.6")
    scatter(whole, xyz, 4, "black")
    window(whole, (0, 0), 45, f"a scan, its {len(xyz):,} centroids")
    neighbours = xyz[j] + p["group_sa1"][j][:, 1:]  # group holds intensity and x_i - x'_j
    draw_ball(ball1, scan, neighbours, xyz[j], sa1.r,
              f"SA1: {sa1.n_n} of the points within {sa1.r:.0f} m")
    draw_ball(ball2, xyz, xyz[p["idx_sa2"][j]], xyz[j], sa2.r,
              f"SA2: centroids within {sa2.r:.0f} m")
    draw_flow(flow, xyz, q["xyz"], xyz[j], config.fe.n_n)
    return figure


def network():
    """Draw Fig. 1: the blocks with their outputs and parameters."""
    net = d3dlo.D3DLO()
    parameters = {name: sum(p.numel() for p in block.parameters())
                  for name, block in net.named_children()}
    figure = metrics.new_figure(11, 2.6)
    axis = figure.subplots()
    axis.set(xlim=(0, 11), ylim=(0, 2.6))
    axis.axis("off")

    def box(x, y, name, title):
        axis.text(x, y, f"{title}\n{parameters[name]:,}", ha="center", va="center",
                  bbox=dict(boxstyle="round,pad=0.4", fc="#dbe7f3", ec="#4a6d8c"))

    def arrow(start, end, label=""):
        axis.annotate("", end, start, arrowprops=dict(arrowstyle="->", color="0.3"))
        middle = np.mean([start, end], 0)
        axis.text(middle[0], middle[1] + 0.14, label, ha="center", va="bottom", fontsize=8)

    for y, scan in (2.1, "P"), (0.7, "Q"):
        arrow((0.5, y), (1.65, y), "N x 4")
        axis.text(0.3, y, scan, ha="center", va="center", fontsize=14)
        box(1.9, y, "sa1", "SA1")
        arrow((2.2, y), (3.5, 1.4 + 0.12 * np.sign(y - 1.4)), "1,024 x 32")
    axis.text(1.9, 1.4, "shared weights", ha="center", va="center", fontsize=8)
    blocks = {"fe": "flow embedding", "sa2": "SA2", "sa3": "SA3", "mpn": "mini-PointNet",
              "mlp": "MLP"}
    places = dict(zip(blocks, (4.2, 5.95, 7.2, 8.65, 10.05)))
    outputs = dict(zip(blocks, ("1,024 x 64", "256 x 64", "64 x 64", "256", "6")))
    begins, ends = (4.95, 6.3, 7.55, 9.35, 10.35), (5.65, 6.9, 7.95, 9.75, 10.75)
    for (name, title), begin, end in zip(blocks.items(), begins, ends):
        box(places[name], 1.4, name, title)
        arrow((begin, 1.4), (end, 1.4), outputs[name])
    axis.text(5.5, 0.15, "In the boxes: parameters, "
              f"{sum(parameters.values()):,} in all. At the arrows: points x features.\n"
              "A point of a scan has x, y, z and intensity. The output is a translation in metres "
              "and three angles in degrees.", ha="center", fontsize=9)
    return figure


COLOURS = {"truth": "0.6", "plain": "tab:orange", "refined": "tab:blue", "KISS-ICP": "tab:green"}


def paths(root, plain, refined, names):
    """Draw the true and the predicted paths of sequences from above, all at the same scale."""
    drives = []
    for s in kitti.open_sequences(root, names):
        simulated = (s.folder / "simulated.json").exists()
        files = [folder / f"{s.name}.txt" for folder in (plain, refined)]
        poses = dict(zip(COLOURS, [s.poses_cam, *map(metrics.read_poses, files)]))
        drives.append(("simulated " * simulated + s.name, poses))
    figure = metrics.new_figure(4.2 * len(drives), 4.6)
    axes = np.atleast_1d(figure.subplots(1, len(drives)))
    points = [np.concatenate([T[:, :3, 3] for T in poses.values()]) for _, poses in drives]
    half = 0.54 * max(np.ptp(xyz[:, [0, 2]], axis=0).max() for xyz in points)  # shared scale
    for axis, (name, poses), xyz in zip(axes, drives, points):
        truth = poses["truth"]
        for label, T in poses.items():
            axis.plot(T[:, 0, 3], T[:, 2, 3], color=COLOURS[label], label=label,
                      lw=4 if label == "truth" else 1.4)
        axis.plot(0, 0, "ko", ms=5)
        drift = {label: np.linalg.norm((T - truth)[-1, :3, 3]) for label, T in poses.items()}
        middle = (xyz.max(0) + xyz.min(0)) / 2
        axis.set(title=f"{name}, {metrics.path_lengths(truth)[-1]:,.0f} m. Off at the end:\n"
                 f"plain {drift['plain']:.1f} m, refined {drift['refined']:.1f} m",
                 xlabel="to the right [m]", ylabel="forward [m]", aspect="equal",
                 xlim=(middle[0] - half, middle[0] + half),
                 ylim=(middle[2] - half, middle[2] + half))
        axis.grid(color="0.9")
    axes[0].legend(frameon=False)
    return figure


# Error of a step [m] that comes from the noise of the ground truth, GPS/IMU; docs/results.md
TRUTH_NOISE = {"drive0013": 0.015, "drive0005": 0.024}


def steps(plain, refined, classical):
    """Draw bars: the error per step on the real drives, plain, refined and of KISS-ICP."""
    folders = {"plain": plain, "refined": refined, "KISS-ICP": classical}
    results = {label: json.loads((folder / "results.json").read_text())["sequences"]
               for label, folder in folders.items()}
    figure = metrics.new_figure(8, 3)
    for axis, key, unit in zip(figure.subplots(1, 2), ("t_step_m", "r_step_deg"), ("cm", "deg")):
        for i, label in enumerate(results):
            heights = np.array([results[label][name][key] for name in TRUTH_NOISE])
            heights *= 100 if unit == "cm" else 1
            axis.bar(np.arange(2) + 0.27 * (i - 1), heights, 0.25, color=COLOURS[label],
                     label=label)
        labels = [name.replace("drive", "real drive ") for name in TRUTH_NOISE]
        axis.set(xticks=range(2), xticklabels=labels, ylabel=f"mean error per step [{unit}]")
        axis.grid(axis="y", color="0.9")
        axis.set_axisbelow(True)
        if unit == "cm":
            for i, noise in enumerate(TRUTH_NOISE.values()):
                axis.plot([i - 0.42, i + 0.42], [100 * noise] * 2, "k--", lw=1,
                          label="noise of the ground truth" if i == 0 else None)
            axis.set_ylim(0, 1.4 * axis.get_ylim()[1])  # room for the legend
            axis.legend(frameon=False, fontsize=8, ncols=2)
    return figure


def curve(run):
    """Draw the training loss and the test loss of each epoch, from a run's log."""
    log = (run / "log.txt").read_text(encoding="utf-8")
    epochs = re.findall(r"^epoch (\d+)/\d+: loss ([\d.]+)(?:, test loss ([\d.]+))?", log, re.M)
    if not epochs:
        raise ValueError(f"{run}/log.txt: holds no epoch")
    epochs = {row[0]: row for row in epochs}.values()  # a resumed run may log an epoch again
    epoch, training, test = np.array([[x or "nan" for x in row] for row in epochs], float).T
    figure = metrics.new_figure(6, 3.3)
    axis = figure.subplots()
    axis.plot(epoch, training, ".-", color="tab:orange", label="training, augmented")
    if not np.isnan(test).all():
        axis.plot(epoch, test, ".-", color="tab:blue", label="test sequences")
    axis.set(xlabel="epoch", ylabel="mean loss, eq. 2 [m and deg]", ylim=(0, None))
    axis.legend(frameon=False)
    axis.grid(color="0.9")
    return figure


def table2(out):
    """Draw the errors of Table 2 by the number of neighbours: the paper's E_t, and our E_t and
    translation per step from OUT/table2.json.
    """
    rows = json.loads((out / "table2.json").read_text(encoding="utf-8"))
    n_n = sorted({neighbours for neighbours, _ in PAPER_2})
    figure = metrics.new_figure(11, 3.2)
    paper, ours, steps = figure.subplots(1, 3)
    for plane, colour in ((True, "tab:blue"), (False, "tab:orange")):
        label = "with the plane" if plane else "without the plane"
        paper.plot(n_n, [PAPER_2[n, plane][0] for n in n_n], "o-", color=colour, label=label)
        for axis, key in ((ours, "E_t"), (steps, "t_step_m")):
            each = [rows[row_of_table_2(n, plane, None)[0]]["all"][key] for n in n_n]  # (5,seeds)
            axis.plot(n_n, np.mean(each, 1), "-", color=colour)
            axis.plot(n_n, each, "o", color=colour, markersize=4)
    paper.set(title="the paper, on KITTI", ylabel="E_t [%]")
    ours.set(title="here, in simulation (dots: seeds)", ylabel="E_t [%]")
    steps.set(title="here, in simulation (dots: seeds)", ylabel="t step [m]")
    for axis in (paper, ours, steps):
        axis.set_xscale("log", base=2)
        axis.set(xticks=n_n, xticklabels=n_n, xlabel="neighbours n_n in SA1",
                 ylim=(0, 1.1 * axis.get_ylim()[1]))
        axis.grid(color="0.9")
    paper.legend(frameon=False, loc="lower left")
    return figure


def main():
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    m = commands.add_parser("method", help="sampling and grouping of two scans")
    m.add_argument("picture", type=Path)
    m.add_argument("--data", metavar="ROOT", help=(
        "folder in KITTI odometry layout (default: the simulated city)"))
    m.add_argument("--sequence", default="03", metavar="NN", help="default: 03")
    m.add_argument("--scan", type=int, default=60, metavar="N", help="default: 60")
    n = commands.add_parser("network", help="the network as in Fig. 1")
    n.add_argument("picture", type=Path)
    p = commands.add_parser("paths", help="true and predicted paths from above")
    p.add_argument("picture", type=Path)
    p.add_argument("data", metavar="ROOT", help="folder in KITTI odometry layout")
    p.add_argument("--sequences", nargs="+", default=["all"], metavar="NN", help="default: all")
    b = commands.add_parser("steps", help="error per step on the real drives")
    b.add_argument("picture", type=Path)
    for command in (p, b):
        command.add_argument("plain", type=Path, metavar="P", help="folder written by eval")
        command.add_argument("refined", type=Path, metavar="R", help="by eval --refine 3")
    b.add_argument("classical", type=Path, metavar="K", help="folder written by classical.py")
    c = commands.add_parser("curve", help="loss by epoch")
    c.add_argument("picture", type=Path)
    c.add_argument("run", type=Path, metavar="RUN", help="folder of a training run")
    t = commands.add_parser("table2", help="the paper's Table 2 and ours")
    t.add_argument("picture", type=Path)
    t.add_argument("out", type=Path, metavar="OUT", help="folder written by experiments.py table2")
    args = parser.parse_args()
    try:
        if args.command == "method":
            root = args.data or kitti.simulate(d3dlo.SIMULATED, sequences=[args.sequence])
            figure = method(root, args.sequence, args.scan)
        elif args.command == "network":
            figure = network()
        elif args.command == "paths":
            figure = paths(args.data, args.plain, args.refined, args.sequences)
        elif args.command == "steps":
            figure = steps(args.plain, args.refined, args.classical)
        elif args.command == "table2":
            figure = table2(args.out)
        else:
            figure = curve(args.run)
        with metrics.replacing(args.picture) as temporary:
            figure.savefig(temporary, format="png", dpi=100)
    except (ValueError, OSError) as error:
        parser.error(str(error))
    print(args.picture)


if __name__ == "__main__":
    main()
