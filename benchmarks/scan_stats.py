"""How much does a simulation, or another sensor, resemble real drives?

    python benchmarks/scan_stats.py ROOT [NN ...]  # folder in KITTI odometry layout, with poses
    python benchmarks/scan_stats.py data/full 00 01 02 08 09

Each line averages 8 pairs of consecutive scans, spread evenly over a sequence. Points and centroids
are cropped as for the pretrained weights, the neighbours below are not:

    points      number of usable points
    intensity   mean intensity
    ground      share of points in the densest 0.3 m of height
    raised      share of centroids more than 0.5 m above the road

Then, for raised centroids by range:

    thick       thickness of the surface: smallest standard deviation of the points within 1 m
                [m], median
    round       smallest over largest standard deviation of these points, mean
    next        distance to the nearest point of the next scan, aligned with the true motion [m],
                median
"""
import argparse
import sys
import warnings
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import d3dlo
import kitti

EDGES = 0, 15, 30, 50  # bounds of the ranges [m]
PAIRS = 8  # pairs of scans of a sequence
RAISED = -1.2  # z of a raised centroid is above this [m]; the road is at -1.73 m


def pair_stats(scan_p, scan_q, T_pq, config):
    """Two scans and their true motion -> kitti.STATS (4,), the share of raised centroids, and for
    each of these its range, thickness, roundness and distance to the next scan (n,4)."""
    record, = d3dlo.scan_records(scan_p, config)
    xyz = record["xyz"].astype(float)
    raised = xyz[xyz[:, 2] > RAISED]  # (n,3)
    p, q = (kitti.usable_points(scan)[0][:, :3].astype(float) for scan in (scan_p, scan_q))
    std = np.full((len(raised), 3), np.nan)  # standard deviations along the principal axes
    for i, near in enumerate(cKDTree(p).query_ball_point(raised, 1.0)):
        if len(near) >= 5:
            std[i] = np.sqrt(np.maximum(np.linalg.eigvalsh(np.cov(p[near].T)), 0))  # ascending
    distance, _ = cKDTree(q @ T_pq[:3, :3].T + T_pq[:3, 3]).query(raised)
    rows = [np.linalg.norm(raised, axis=1), std[:, 0], std[:, 0] / std[:, 2], distance]
    return record["stats"], len(raised) / len(xyz), np.stack(rows, 1)


def sequence_line(s, config):
    """The line of the table for a `kitti.Sequence`. Raises ValueError without ground truth."""
    motions = s.motions()
    if not len(motions):
        raise ValueError(f"sequence {s.name} has one scan; two are needed")
    chosen = np.unique(np.linspace(0, len(motions) - 1, PAIRS).astype(int))
    stats, raised, rows = zip(*[pair_stats(s.scan(i), s.scan(i + 1), motions[i], config)
                                for i in chosen])
    points, intensity, _, ground = np.mean(stats, 0)
    line = f"{s.name:<12}{points:6.0f}  {intensity:9.2f}  {ground:6.2f}  {np.mean(raised):6.2f}"
    rows = np.concatenate(rows)
    for low, high in zip(EDGES, EDGES[1:]):
        _, thick, roundness, following = rows[(rows[:, 0] > low) & (rows[:, 0] <= high)].T
        line += (f"{np.nanmedian(thick):21.3f} {np.nanmean(roundness):5.2f} "
                 f"{np.median(following):4.2f}")
    return line


def main():
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("root", metavar="ROOT")
    parser.add_argument("names", nargs="*", metavar="NN", help="sequences (default: all)")
    args = parser.parse_args()
    warnings.simplefilter("ignore", RuntimeWarning)  # a range without centroids gives NaN
    config = d3dlo.load_weights()[0].config
    ranges = [f"   {low:2d} to {high} m: thick round next" for low, high in zip(EDGES, EDGES[1:])]
    try:
        sequences = kitti.open_sequences(args.root, args.names or "all")
        print(f"{'sequence':<12}points  intensity  ground  raised", *ranges, sep="")
        for s in sequences:
            print(sequence_line(s, config), flush=True)
    except (ValueError, OSError) as error:
        sys.exit(f"scan_stats: {error}")


if __name__ == "__main__":
    main()
