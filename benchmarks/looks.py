"""What the network sees of scans: to compare a simulation, or another sensor, with the real drives.

    python benchmarks/looks.py ROOT [NN ...]        # folders in KITTI odometry layout, with poses
    python benchmarks/looks.py data/full 00 01 02 08 09

For each sequence, over 8 scans spread evenly: usable points, mean intensity, share of points in the fullest 0.3 m of height (the ground),
share of the centroids more than 0.5 m above the road (raised). Then of these, by range: how thick the surface is within 1 m [m] (smallest
standard deviation, median), how round (smallest over largest, mean), and how far the nearest point of the next scan lies once the true
motion is undone [m] (median).
"""
import argparse
import sys
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import d3dlo
import kitti

EDGES = 0, 15, 30, 50


def of_pair(P, Q, T_pq, config):
    """Two scans and their motion -> LOOKS (4,), and of every raised centroid range, thickness, roundness, distance (n,4); their share."""
    record = d3dlo.scan_geometry(P, config)
    centroids = record["xyz"][record["xyz"][:, 2] > -1.2].astype(float)
    xyz = P[:, :3].astype(float)
    tree, there = cKDTree(xyz), cKDTree(Q[:, :3].astype(float) @ T_pq[:3, :3].T + T_pq[:3, 3])
    sizes = np.full((len(centroids), 3), np.nan)
    for size, near in zip(sizes, tree.query_ball_point(centroids, 1.0)):
        if len(near) >= 5:
            size[:] = np.sqrt(np.maximum(np.linalg.eigvalsh(np.cov(xyz[near].T)), 0))
    rows = np.stack([np.linalg.norm(centroids, axis=1), sizes[:, 0], sizes[:, 0] / sizes[:, 2], there.query(centroids)[0]], 1)
    return record["looks"], rows, len(centroids) / len(record["xyz"])


def main():
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("root", metavar="ROOT")
    parser.add_argument("names", nargs="*", metavar="NN")
    args = parser.parse_args()
    config = d3dlo.Config()
    try:
        sequences = kitti.open_sequences(args.root, args.names or "all")
        truth = [s.motions() for s in sequences]
    except (ValueError, OSError) as error:
        sys.exit(f"looks: {error}")
    print(f"{'sequence':<12}points  intensity  ground  raised   "
          + "   ".join(f"{a:2d} to {b} m: thick round next" for a, b in zip(EDGES, EDGES[1:])))
    for s, motions in zip(sequences, truth):
        looks, rows, raised = zip(*(of_pair(s.scan(i), s.scan(i + 1), motions[i], config) for i in np.linspace(0, len(s) - 2, 8).astype(int)))
        (points, intensity, _, ground), rows = np.mean(looks, 0), np.concatenate(rows)
        line = f"{s.name:<12}{points:6.0f}  {intensity:9.2f}  {ground:6.2f}  {np.mean(raised):6.2f}   "
        for a, b in zip(EDGES, EDGES[1:]):
            some = rows[(rows[:, 0] > a) & (rows[:, 0] <= b)]
            line += f"{np.nanmedian(some[:, 1]):18.3f} {np.nanmean(some[:, 2]):5.2f} {np.median(some[:, 3]):4.2f}   "
        print(line, flush=True)


if __name__ == "__main__":
    main()
