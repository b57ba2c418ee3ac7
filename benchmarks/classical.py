"""How well does KISS-ICP, a classical method, do on the scans and with the metric of `eval`?

    pip install kiss-icp==1.3.0
    python benchmarks/classical.py ROOT OUT          # ROOT in KITTI odometry layout, with poses
    python benchmarks/classical.py ROOT OUT --sequences 2011_09_26_drive_0005

KISS-ICP aligns each scan with a map of the scans before it. Writes OUT/NN.txt, KITTI pose files in
the rectified left camera frame, and OUT/results.json. Prints the settings, and a table of errors.
"""
import argparse
import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import d3dlo
import kitti
import metrics


class KissIcp:
    """KISS-ICP with its default settings, but for 1 m voxels and without deskewing.

    1 m is what it chooses itself for a range of 100 m. Deskewing needs the time of every point,
    which KITTI's odometry data do not have. Raises ValueError if the package is not installed.
    """

    def __init__(self):
        try:
            from kiss_icp.config import KISSConfig
            from kiss_icp.kiss_icp import KissICP
        except ImportError:
            raise ValueError("KISS-ICP is not installed: pip install kiss-icp==1.3.0") from None
        config = KISSConfig()
        config.data.deskew, config.data.max_range, config.mapping.voxel_size = False, 100.0, 1.0
        self.icp, self.settings = KissICP(config), config.model_dump(exclude={"out_dir"})

    def register(self, scan):
        """Scan (N,4) -> its pose T_0t (4,4), Velodyne frame."""
        self.icp.register_frame(scan[:, :3].astype(float), np.zeros(len(scan)))
        return self.icp.last_pose


def evaluate(root, names, out):
    """Write OUT/NN.txt and OUT/results.json for some sequences of `root`, and print the table."""
    d3dlo.check_output(out, "results", root)
    settings = KissIcp().settings
    method = f"KISS-ICP {version('kiss-icp')}"
    print(method, *(f"{part}: {values}" for part, values in settings.items()), sep="\n")
    errors, results = [], {}
    for s in kitti.open_sequences(root, names):
        s.motions()  # ValueError without ground truth
        icp = KissIcp()
        poses = np.stack([icp.register(s.scan(i)) for i in kitti.progress(
            range(len(s)), len(s), f"registering {s.name}, scans")])  # (n,4,4)
        poses_cam = kitti.velo_to_camera(poses, s.Tr)
        metrics.write_poses(out / f"{s.name}.txt", poses_cam)
        errors.append((metrics.segment_errors(s.poses_cam, poses_cam),
                       metrics.step_errors(s.poses, poses)))
        results[s.name] = metrics.summary(*zip(errors[-1]))
    pooled = metrics.summary(*zip(*errors))
    metrics.write_json(out / "results.json", {
        "method": method, "settings": settings, "data": str(root), "sequences": results,
        "pooled": pooled})
    print(metrics.table([*results.items(), ("all", pooled)]),
          "E_t, E_r: rectified left camera frame. t step, r step: Velodyne frame.",
          f"trajectories  {out}/NN.txt", f"errors        {out}/results.json", sep="\n")


def main():
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("root", metavar="ROOT")
    parser.add_argument("out", metavar="OUT", type=Path, help="new or empty folder")
    parser.add_argument("--sequences", nargs="+", default="all", metavar="NN", help="default: all")
    args = parser.parse_args()
    try:
        evaluate(args.root, args.sequences, args.out)
    except (ValueError, OSError) as error:
        sys.exit(f"classical: {error}")


if __name__ == "__main__":
    main()
