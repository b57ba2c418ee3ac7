"""Draw estimated trajectories against the truth, from above. Needs matplotlib: pip install ".[plot]"

    python benchmarks/trajectories.py data/simulated/poses results/TIME docs/trajectory.png 05 06 10
"""
import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import metrics


def main():
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("gt", type=Path, help="folder of true poses NN.txt")
    parser.add_argument("est", type=Path, help="folder of estimated ones")
    parser.add_argument("picture", type=Path)
    parser.add_argument("sequences", nargs="+", metavar="NN")
    args = parser.parse_args()
    try:
        import matplotlib
    except ImportError:
        sys.exit("this needs matplotlib: pip install \".[plot]\"")
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, len(args.sequences), figsize=(3.6 * len(args.sequences), 3.6), squeeze=False, layout="constrained")
    for axis, name in zip(axes[0], args.sequences):
        for folder, style in (args.gt, dict(color="0.65", lw=4, label="truth")), (args.est, dict(color="black", lw=1.2, label="D3DLO")):
            T = metrics.read_poses(folder / f"{name}.txt")
            axis.plot(T[:, 0, 3], T[:, 2, 3], **style)      # KITTI's camera: x right, z forward
        axis.plot(0, 0, "ko", ms=5)
        axis.set(title=f"sequence {name}", xlabel="x [m]", ylabel="z [m]", aspect="equal", adjustable="datalim")
        axis.grid(color="0.9")
    axes[0, 0].legend(frameon=False)
    figure.savefig(args.picture, dpi=110)
    print(f"{args.picture}: camera frame, metres, from above; the dot is the start")


if __name__ == "__main__":
    main()
