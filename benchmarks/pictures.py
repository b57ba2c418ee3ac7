"""Draws the pictures of the documentation. Needs matplotlib: pip install ".[plot]"

    python benchmarks/pictures.py tour docs/tour.ipynb        # run the notebook, keep its outputs
    python benchmarks/pictures.py network docs/network.png    # Fig. 1 with shapes and parameters
    python benchmarks/pictures.py curve docs/curve.png RUN    # loss by epoch of a training run
    python benchmarks/pictures.py table2 docs/table2.png runs/experiments

Trajectories and errors come from two evaluations of the same data, plain and refined:

    python d3dlo.py eval --data ROOT --out P && python d3dlo.py eval --data ROOT --refine 3 --out R
    python benchmarks/pictures.py paths docs/paths.png ROOT P R --sequences 03 06 10
    python benchmarks/pictures.py cloud docs/cloud.png ROOT R --sequences 06
"""
import argparse
import base64
import contextlib
import io
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

COLOURS = {"truth": "0.6", "plain": "tab:orange", "refined": "tab:blue"}


def tour(notebook):
    """Run the cells of a notebook, and store what they print and draw in it."""
    import matplotlib.pyplot as plt  # only here, since it chooses a backend

    content, names = json.loads(notebook.read_text(encoding="utf-8")), {}
    for number, cell in enumerate(content["cells"]):
        if cell["cell_type"] != "code":
            continue
        with contextlib.redirect_stdout(io.StringIO()) as printed:
            exec(compile("".join(cell["source"]), f"cell {number}", "exec"), names)
        text, cell["outputs"] = printed.getvalue(), []
        if text:
            cell["outputs"].append({"output_type": "stream", "name": "stdout",
                                    "text": text.splitlines(True)})
        for figure in map(plt.figure, plt.get_fignums()):
            picture = io.BytesIO()
            figure.savefig(picture, format="png", dpi=70, bbox_inches="tight")
            image = base64.b64encode(picture.getvalue()).decode()
            cell["outputs"].append({"output_type": "display_data", "metadata": {},
                                    "data": {"image/png": image}})
        plt.close("all")
    text = json.dumps(content, indent=1, ensure_ascii=False) + "\n"
    with metrics.replacing(notebook) as temporary:
        temporary.write_text(text, encoding="utf-8")


def network():
    """Draw Fig. 1: the blocks with their outputs and parameters."""
    parameters = {name: sum(p.numel() for p in block.parameters())
                  for name, block in d3dlo.D3DLO().named_children()}
    figure = metrics.new_figure(11, 2.6)
    axis = figure.subplots()
    axis.set(xlim=(0, 11), ylim=(0, 2.6))
    axis.axis("off")

    def write(x, y, text, size=9, **style):
        axis.text(x, y, text, ha="center", va="center", fontsize=size, **style)

    def box(x, y, name, title):
        write(x, y, f"{title}\n{parameters[name]:,}", 10,
              bbox=dict(boxstyle="round,pad=0.4", fc="#dbe7f3", ec="#4a6d8c"))

    def arrow(start, end, label):
        axis.annotate("", end, start, arrowprops=dict(arrowstyle="->", color="0.3"))
        write(*np.mean([start, end], 0) + [0, 0.2], label, 8)

    for y, end, scan in (2.1, 1.52, "P"), (0.7, 1.28, "Q"):
        write(0.3, y, scan, 14)
        arrow((0.5, y), (1.65, y), "N x 4")
        box(1.9, y, "sa1", "SA1")
        arrow((2.2, y), (3.5, end), "1,024 x 32")
    write(1.9, 1.4, "shared weights", 8)
    for x, name, title, begin, end, output in (
            (4.2, "fe", "flow embedding", 4.95, 5.65, "1,024 x 64"),
            (5.95, "sa2", "SA2", 6.3, 6.9, "256 x 64"),
            (7.2, "sa3", "SA3", 7.55, 7.95, "64 x 64"),
            (8.65, "mpn", "mini-PointNet", 9.35, 9.75, "256"),
            (10.05, "mlp", "MLP", 10.35, 10.75, "6")):
        box(x, 1.4, name, title)
        arrow((begin, 1.4), (end, 1.4), output)
    write(5.5, 0.25, "In the boxes: parameters, "
          f"{sum(parameters.values()):,} in all. At the arrows: points x features.\n"
          "A point of a scan has x, y, z and intensity. The output is a translation in metres "
          "and three angles in degrees.")
    return figure


def paths(root, plain, refined, sequences):
    """Draw the true and the predicted paths of sequences from above."""
    drives = kitti.open_sequences(root, sequences)
    for s in drives:
        s.motions()  # ValueError without ground truth
    estimates = {label: [metrics.read_poses(folder / f"{s.name}.txt") for s in drives]
                 for label, folder in (("plain", plain), ("refined", refined))}
    figure = metrics.new_figure(4.2 * len(drives), 4.6)
    axes = np.atleast_1d(figure.subplots(1, len(drives)))
    for axis, s, *predicted in zip(axes, drives, *estimates.values()):
        end = s.poses_cam[-1, :3, 3]
        off = [np.linalg.norm(T[-1, :3, 3] - end) for T in predicted]
        for label, T in zip(COLOURS, (s.poses_cam, *predicted)):
            axis.plot(T[:, 0, 3], T[:, 2, 3], color=COLOURS[label], label=label,
                      lw=4 if label == "truth" else 1.4)
        axis.plot(0, 0, "ko", ms=5)
        simulated = "simulated " * (s.folder / "simulated.json").exists()
        axis.set(title=f"{simulated}{s.name}, {metrics.path_lengths(s.poses_cam)[-1]:,.0f} m. "
                 f"Off at the end:\nplain {off[0]:.1f} m, refined {off[1]:.1f} m",
                 xlabel="to the right [m]", ylabel="forward [m]")
        axis.set_aspect("equal", adjustable="datalim")
        axis.grid(color="0.9")
    axes[0].legend(frameon=False)
    return figure


def cloud(root, refined, sequences):
    """Draw the scans of a sequence in its predicted poses, from an angle, coloured by height."""
    s = kitti.open_sequences(root, sequences)[0]
    T = kitti.camera_to_velo(metrics.read_poses(refined / f"{s.name}.txt"), s.Tr)  # (n,4,4)
    parts = []
    for i in range(len(s)):
        scan = s.scan(i)[:, :3]
        scan = scan[np.linalg.norm(scan, axis=1) < 35]
        parts.append(np.c_[scan @ T[i, :3, :3].T + T[i, :3, 3], scan[:, 2] + kitti.SENSOR_HEIGHT])
    points = np.concatenate(parts)  # (m,4): position, and height above the road
    _, first = np.unique(np.round(points[:, :3] / 0.15), axis=0, return_index=True)
    points, path = points[first], T[:, :3, 3]

    # Turn the long side of the path to the right, then look down at an angle of 40 degrees
    centred = path[:, :2] - path[:, :2].mean(0)
    right = np.linalg.svd(centred, full_matrices=False)[2][0]  # (2,)
    axes = np.array([[*right, 0], [*(np.array([-right[1], right[0]]) * np.sin(np.radians(40))),
                                   np.cos(np.radians(40))]])  # (2,3): to the right, upwards
    ahead = points[:, :2] @ [-right[1], right[0]]
    points = points[np.argsort(-ahead)]  # the nearest ones are drawn last
    u, v = axes @ points[:, :3].T
    figure = metrics.new_figure(10, 10 * np.ptp(v) / np.ptp(u) + 0.6)
    figure.set_facecolor("black")
    axis = figure.subplots()
    axis.set_aspect("equal")
    axis.axis("off")
    axis.scatter(u, v, s=0.25, c=points[:, 3], cmap="turbo", vmin=-1, vmax=6, linewidths=0)
    axis.plot(*(axes @ path.T), color="white", lw=1.5)
    simulated = "simulated " * (s.folder / "simulated.json").exists()
    axis.set_title(f"{simulated}drive {s.name}: {len(s)} scans in the predicted poses, a path of "
                   f"{metrics.path_lengths(T)[-1]:,.0f} m", color="white")
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
            each = np.array([rows[row_of_table_2(n, plane, None)[0]]["all"][key] for n in n_n],
                            float)  # (5,seeds)
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


FOLDERS = {tour: [], network: [], curve: ["run"], table2: ["out"], cloud: ["root", "refined"],
           paths: ["root", "plain", "refined"]}


def command_line():
    """Parse the arguments. Returns a function that draws, its arguments, and the file to write."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    for draw, folders in FOLDERS.items():
        command = commands.add_parser(draw.__name__, description=draw.__doc__)
        command.set_defaults(draw=draw)
        command.add_argument("picture", type=Path, metavar="FILE", help="the file to write")
        for folder in folders:
            command.add_argument(folder, type=Path, metavar=folder.upper())
        if "root" in folders:
            command.add_argument("--sequences", nargs="+", default="all", metavar="NN")
    args = vars(parser.parse_args())
    args.pop("command")
    return args.pop("draw"), args.pop("picture"), args


def main():
    """Run the command line."""
    draw, picture, args = command_line()
    try:
        if draw is tour:
            tour(picture)
        else:
            figure = draw(**args)
            with metrics.replacing(picture) as temporary:
                figure.savefig(temporary, format="png", dpi=100)
    except (ValueError, OSError) as error:
        sys.exit(f"pictures: {error}")
    except KeyError as error:
        sys.exit(f"pictures: a results.json or table2.json holds nothing about {error}")
    print(picture)


if __name__ == "__main__":
    main()
