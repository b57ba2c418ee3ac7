"""How fast is each part, compared with a baseline that is measured in the same run?

    python benchmarks/bench.py                  # on simulated scans
    python benchmarks/bench.py --data ROOT      # on scans in KITTI odometry layout
    python benchmarks/bench.py fps training     # some rows only
    python benchmarks/bench.py register refine training --busy    # while all cores are busy
    python benchmarks/bench.py --against DIR    # compared with another checkout

Every measurement runs in a process of its own. In each round this code and its baselines take
turns, so other work on the machine slows both. The table shows the median time of each, and the
median and the range of baseline / here over the rounds. A pair-step is one pair of scans in one
training step.

With --against, the code in DIR is the baseline: of this version, of a later one, or of commit
b9e6db3. fpsample and kiss-icp are baselines if they are installed. The processes inherit the
environment, so OMP_WAIT_POLICY=ACTIVE, for example, can be tried. Linux only.
"""
import argparse
import functools
import importlib.util
import os
import platform
import re
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

ENVIRONMENT = dict(os.environ)  # before d3dlo adds to it
HERE = Path(__file__).resolve().parents[1]
sys.path.insert(0, os.environ.get("D3DLO_CHECKOUT", str(HERE)))  # of a child: another checkout
import d3dlo
import kitti

OLD = hasattr(d3dlo, "scan_geometry")  # commit b9e6db3
SCANS, EPOCHS, WARM_UP = 33, 6, 2  # 32 pairs in two batches an epoch; epochs not counted
CONFIG = d3dlo.Config(max_range=50.0, epochs=EPOCHS, batch=16, augment=True)
KITTI_SCANS = 15965  # scans of the paper's training split of KITTI

# ------------------------------------------------------------------------------------------------
# Measurements: functions of a `kitti.Sequence` and of a form, which is "here" or a baseline's name.
# They return seconds.


def seconds(work, repeat=9):
    """Median time of a call, not counting the first."""
    times = []
    for _ in range(1 + repeat):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return np.median(times[1:])


def textbook_fps(xyz, n):
    """Farthest point sampling: update the distances of all points for each centroid."""
    points, centroids = np.ascontiguousarray(xyz.T), np.zeros(n, np.int64)
    min_dist = np.full(len(xyz), np.inf, np.float32)
    for i in range(1, n):
        dx, dy, dz = points - points[:, centroids[i - 1], None]
        min_dist = np.minimum(min_dist, dx * dx + dy * dy + dz * dz)
        centroids[i] = min_dist.argmax()
    return centroids


def fps(s, form):
    """Farthest point sampling of 1,024 points of a scan."""
    xyz = np.ascontiguousarray(s.scan(len(s) // 2)[:, :3])
    if form == "textbook loop":
        return seconds(lambda: textbook_fps(xyz, 1024))
    if form == "fpsample exact":
        import fpsample
        return seconds(lambda: fpsample.fps_sampling(xyz, 1024, start_idx=0))
    if form == "fpsample buckets":
        import fpsample
        return seconds(lambda: fpsample.bucket_fps_kdline_sampling(xyz, 1024, h=7, start_idx=0))
    return seconds(lambda: d3dlo.farthest_point_sampling(xyz, 1024))


def records(s, form, n=1):
    """Sampling and grouping of a scan."""
    scan = s.scan(len(s) // 2)
    return seconds(lambda: d3dlo.scan_records(scan, CONFIG, n))


def register(s, form, refine=0):
    """Registering a scan of a stream. The scans are in memory."""
    scans = [s.scan(i) for i in range(SCANS)]
    if form == "KISS-ICP":
        from classical import KissIcp  # beside this file
        work = KissIcp().register
    else:
        work = d3dlo.Odometry(refine=refine).register
    todo = iter(scans)
    return seconds(lambda: work(next(todo)), len(scans) - 1)


def prepare(s):
    """Records (n,) and motions (n-1,4,4) of the first scans."""
    scans = [s.scan(i) for i in range(SCANS)]
    sampled = [d3dlo.scan_geometry(scan, CONFIG)[None] if OLD else d3dlo.scan_records(scan, CONFIG)
               for scan in scans]
    return np.concatenate(sampled), s.motions()[:SCANS - 1]


def training(s, form, frozen=0.0):
    """A pair-step, from the times at which `fit` reports its epochs. Includes making batches."""
    if form != "default malloc":
        kitti.keep_freed_memory()
    records, motions = prepare(s)
    data = ([records], [motions]) if OLD else ([(records, motions)],)
    net, times = d3dlo.D3DLO(replace(CONFIG, frozen=frozen)), []
    with tempfile.TemporaryDirectory() as run:
        d3dlo.fit(net, *data, run, say=lambda line: times.append(time.perf_counter()))
    return np.median(np.diff(times[WARM_UP - 1:EPOCHS])) / len(motions)


def loader(s, form):
    """Preparing a batch, a pair-step. "eq. 4 on the device" leaves neighbours in Q to the device.

    The device "meta" computes nothing, so what is left is the work of the CPU beside a GPU.
    """
    device, steps = "cpu" if form == "here" else "meta", 20
    data, work = [prepare(s)], (CONFIG, (0,), 0, steps)
    return seconds(lambda: [*d3dlo.batches(data, *work, device)], 3) / (CONFIG.batch * steps)


def inference(s, form):
    """The network on one of 32 pairs in a batch. The records are given."""
    records, _ = prepare(s)
    p = np.arange(len(records) - 1)
    batch, net = d3dlo.make_batch(records, p, p + 1, CONFIG), d3dlo.D3DLO(CONFIG).eval()
    import torch  # after d3dlo, which makes its idle threads sleep
    with torch.inference_mode():
        return seconds(lambda: net(batch)) / len(p)


def cache(s, form):
    """Sampling and grouping of a whole sequence."""
    if form == "one worker":
        kitti.cores = lambda: 1
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        d3dlo.load_records([s], CONFIG, folder)
    return time.perf_counter() - start


def startup(s, form):
    """Starting the command line and printing its help."""
    command = [sys.executable, *(["-c", form] if form != "here" else [HERE / "d3dlo.py", "-h"])]
    return seconds(lambda: subprocess.run(command, check=True, capture_output=True), 3)


def memory(s, form):
    """Peak memory of a training run, without the pages of its cache, a text."""
    training(s, form)
    peak = int(re.search(r"VmHWM:\s*(\d+) kB", Path("/proc/self/status").read_text())[1])
    cache = KITTI_SCANS * d3dlo.record_dtype(CONFIG).itemsize
    return (f"training: {peak / 2**20:.2f} GiB, and up to {cache / 2**30:.2f} GiB for the pages of "
            "the cache of the paper's training split")


# ------------------------------------------------------------------------------------------------
# The table

ROWS = {  # measurement, its name in the table, baselines
    "fps": (fps, "FPS, 1,024 points of a scan",
            "textbook loop", "fpsample exact", "fpsample buckets"),
    "records": (records, "sampling and grouping, a scan"),
    "samplings": (functools.partial(records, n=3), "the same, three samplings"),
    "register": (register, "Odometry.register, a scan", "KISS-ICP"),
    "refine": (functools.partial(register, refine=3), "the same, refine=3", "KISS-ICP"),
    "training": (training, "training, a pair-step in a batch of 16"),
    "fixed": (functools.partial(training, frozen=0.999), "the same, fixed statistics"),
    "loader": (loader, "preparing batches, a pair-step", "eq. 4 on the device"),
    "inference": (inference, "network on a pair, records given"),
    "cache": (cache, "sampling and grouping, a sequence", "one worker"),
    "startup": (startup, "d3dlo.py --help", "import torch"),
    "malloc": (training, "training, a pair-step in a batch of 16", "default malloc"),
    "memory": (memory, "memory of training")}
ON_REQUEST = "malloc", "memory"
AGAINST = "fps", "register", "refine", "training", "fixed"  # rows that --against can compare
PACKAGES = {"fpsample exact": "fpsample", "fpsample buckets": "fpsample", "KISS-ICP": "kiss_icp"}


def in_child(name, s, form, checkout):
    """Measure in a separate process, with the code of a checkout. Returns what it prints."""
    command = [sys.executable, __file__, "--child", name, form, s.folder.parents[1], s.name]
    done = subprocess.run(command, capture_output=True, text=True,
                          env=ENVIRONMENT | {"D3DLO_CHECKOUT": str(checkout)})
    if done.returncode:
        sys.exit(f"bench: {name}, {form}, {checkout}:\n{done.stderr}")
    return done.stdout.strip()


def compare(name, s, rounds, against):
    """Measure a row. Prints a line of the table for each baseline, or one if there is none."""
    _, work, *baselines = ROWS[name]
    forms = [(form, HERE) for form in ("here", *baselines)
             if form not in PACKAGES or importlib.util.find_spec(PACKAGES[form])]
    if against:
        forms = [("here", HERE), ("here", against)]
    times = np.array([[float(in_child(name, s, *form)) for form in forms] for _ in range(rounds)])
    here, *others = [f"{1000 * t:.3g} ms" if t < 1 else f"{t:.3g} s" for t in np.median(times, 0)]
    if not others:
        print(f"| {work} | {here} | | | |", flush=True)
    for (form, _), other, ratio in zip(forms[1:], others, (times[:, 1:] / times[:, :1]).T):
        print(f"| {work} | {here} | {against or form} {other} | {np.median(ratio):.2f} "
              f"| {ratio.min():.2f} to {ratio.max():.2f} |", flush=True)


def start_busy_loops():
    """Keep every core busy until this process ends."""
    loop = f"import os\nwhile os.getppid() == {os.getpid()}: pass"
    for _ in range(kitti.cores()):
        subprocess.Popen([sys.executable, "-c", loop])


def command_line():
    """Parse the arguments."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rows", nargs="*", metavar="ROW", help=(
        f"of {', '.join(ROWS)} (default: all but {' and '.join(ON_REQUEST)})"))
    parser.add_argument("--data", metavar="ROOT", help=(
        "folder in KITTI odometry layout (default: simulated scans, made in data/bench)"))
    parser.add_argument("--sequence", default="all", metavar="NN", help="default: the longest one")
    parser.add_argument("--rounds", type=int, default=5, metavar="N", help="default: 5")
    parser.add_argument("--busy", action="store_true", help="keep every core busy meanwhile")
    parser.add_argument("--against", type=Path, metavar="DIR", help=(
        f"compare with another checkout; rows: {', '.join(AGAINST)}"))
    args = parser.parse_args()
    known = AGAINST if args.against else ROWS
    if unknown := set(args.rows) - set(known):
        parser.error(f"no such row: {', '.join(unknown)}; choose from {', '.join(known)}")
    if args.against and not (args.against / "d3dlo.py").is_file():
        parser.error(f"{args.against}: holds no d3dlo.py")
    args.rows = args.rows or [name for name in known if name not in ON_REQUEST]
    return args


def main():
    """Run the command line."""
    if sys.argv[1:2] == ["--child"]:  # the process of `in_child`
        name, form, root, sequence = sys.argv[2:]
        return print(ROWS[name][0](*kitti.open_sequences(root, [sequence]), form))
    args = command_line()
    try:
        root = args.data or kitti.simulate("data/bench", sequences=["00"], scans=100)
        s = max(kitti.open_sequences(root, args.sequence), key=len)
        if len(s.motions()) < SCANS - 1:  # ValueError without ground truth
            raise ValueError(f"sequence {s.name} has {len(s)} scans, but {SCANS} are needed")
    except (ValueError, OSError) as error:
        sys.exit(f"bench: {error}")
    versions = ", ".join(f"{name} {value}" for name, value in kitti.versions(HERE).items())
    print(f"{kitti.cores()} cores of {platform.machine()}{', kept busy' * args.busy}; {versions}\n"
          f"sequence {s.name}, {len(s)} scans; {args.rounds} rounds\n\n"
          "| work | here | baseline | ratio, median | ratio, range |\n|---|---|---|---|---|")
    if args.busy:
        start_busy_loops()
    for name in args.rows:
        if name == "memory":
            print(in_child(name, s, "here", HERE))
        else:
            compare(name, s, args.rounds, args.against and args.against.resolve())


if __name__ == "__main__":
    main()
