"""Speed of each part against a baseline measured in the same run.

    python benchmarks/bench.py  # on a few simulated scans
    python benchmarks/bench.py --data ROOT  # on scans in KITTI odometry layout
    python benchmarks/bench.py fps training  # some rows only
    python benchmarks/bench.py --against DIR  # this checkout against another one

Every measurement runs in a process of its own. In each round the baseline and this code take
turns, so a busy machine slows both. The table shows the median time of each, and the median and
range of their ratio over the rounds.

With --against, DIR holds another version of d3dlo.py with the current interface. Its code is the
baseline.

The row `metric` needs the test packages, pip install ".[test]". fpsample and kiss-icp are baselines
if they are installed. Linux only. Run nothing else on the machine.
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
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

HERE = Path(__file__).resolve().parents[1]
sys.path.insert(0, os.environ.get("D3DLO_CHECKOUT", str(HERE)))  # of a child: another checkout
import d3dlo
import kitti
import metrics
from d3dlo import Config

CONFIG = Config(max_range=50.0, plane=True, batch=16, optimizer="adam", lr=1e-3, schedule="steps",
                swap="both", augment=True, frozen=0.0)  # both directions: 32 pairs in a batch
SCANS = 33  # scans prepared for training and inference, so 32 pairs
STEPS, WARM_UP = 12, 4  # training steps; the first WARM_UP are not counted
KITTI_PAIRS = 15960  # pairs of the training split
KITTI_POSES = 4541, 1101, 4661, 801, 271, 2761, 1101, 1101, 4071, 1591, 1201  # 00 to 10


# Measurements: functions of a `kitti.Sequence` and a form, which return seconds. The form "here" is
# what users run.

def seconds(work, repeat=9):
    """Median time of a call, not counting the first."""
    times = []
    for _ in range(1 + repeat):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return np.median(times[1:])


def one_core():
    """Keep this process, and threads it starts, on one core."""
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})


def fps(s, form):
    """Farthest point sampling of 1,024 points of a scan."""
    one_core()
    xyz = np.ascontiguousarray(s.scan(len(s) // 2)[:, :3])
    if form == "textbook loop":
        return seconds(lambda: d3dlo.fps_textbook(xyz, 1024))
    if form == "fpsample exact":
        import fpsample
        return seconds(lambda: fpsample.fps_sampling(xyz, 1024, start_idx=0))
    if form == "fpsample buckets":
        import fpsample
        return seconds(lambda: fpsample.bucket_fps_kdline_sampling(xyz, 1024, h=7, start_idx=0))
    return seconds(lambda: d3dlo.farthest_point_sampling(xyz, 1024))


def geometry(s, form):
    """Sampling and grouping of a scan, by `scan_geometry`."""
    one_core()
    if form == "textbook FPS":
        d3dlo.farthest_point_sampling = d3dlo.fps_textbook
    scan = s.scan(len(s) // 2)
    return seconds(lambda: d3dlo.scan_geometry(scan, CONFIG))


def register(s, form, refine=0):
    """Registering a scan of a stream; the scans are in memory."""
    scans = [s.scan(i) for i in range(min(SCANS, len(s)))]
    if form == "KISS-ICP":
        from classical import kiss_icp  # beside this file
        icp = kiss_icp()
        todo = iter([(scan[:, :3].astype(float), np.zeros(len(scan))) for scan in scans])
        return seconds(lambda: icp.register_frame(*next(todo)), len(scans) - 1)
    odometry, todo = d3dlo.Odometry(refine=refine), iter(scans)
    return seconds(lambda: odometry.register(next(todo)), len(scans) - 1)


def prepare(s, form):
    """Prepare the network in one of its forms, and records and motions of a sequence for `fit`.

    Forms: "plain" and "here", the fast one; either may be "compiled"; "default malloc" is the fast
    one without `keep_freed_memory`.
    """
    if form != "default malloc":
        kitti.keep_freed_memory()
    torch.manual_seed(0)
    net = d3dlo.D3DLO(CONFIG)
    net = net if form.startswith("plain") else d3dlo.fast(net)
    if form.endswith("compiled"):
        for function in d3dlo.GatherAdd, d3dlo.LinearMax:  # a compiler would unroll their loops
            function.apply = torch.compiler.disable(function.apply)
        net.compile()
    n = min(SCANS, len(s))
    records = np.stack([d3dlo.scan_geometry(s.scan(i), CONFIG) for i in range(n)])
    return net, [records], [s.motions()[:n - 1]]


def inference(s, form):
    """The network on one of 32 pairs in a batch, without sampling and grouping."""
    net, geometry, motions = prepare(s, form)
    pairs = [(0, i) for i in range(min(16, len(motions[0])))]
    batch, _ = d3dlo.training_batch(geometry, motions, pairs, CONFIG, np.random.default_rng(0))
    net.eval()
    with torch.inference_mode():
        return seconds(lambda: net(batch)) / len(batch.p)


def training_steps(net, geometry, motions, batches, frozen=False):
    """Train on the first STEPS batches and prepare the others. Returns seconds per pair."""
    run = d3dlo.Training(net, geometry, motions, "")
    run.model = net  # the form to measure
    run.frozen_from = -1 if frozen else batches
    times, last = [], time.perf_counter()
    for i, (batch, T) in enumerate(d3dlo.batches(geometry, motions, CONFIG, (0,), 0, batches)):
        if i < STEPS:
            run.train_step(batch, T)
            times.append((time.perf_counter() - last) / len(T))
            last = time.perf_counter()
    return np.median(times[WARM_UP:])


def training(s, form):
    """A training step, divided by the pairs in its batch. Batches are prepared in parallel."""
    return training_steps(*prepare(s, form), STEPS)


def fixed_statistics(s, form):
    """A training step with fixed BatchNorm statistics, as at the end of training."""
    return training_steps(*prepare(s, form), STEPS, frozen=True)


def cache(s, form):
    """Sampling and grouping of a whole sequence."""
    if form == "one worker":
        kitti.cores = lambda: 1
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        d3dlo.load_geometry([s], CONFIG, folder)
    return time.perf_counter() - start


def start_up(s, form):
    """Starting the command line and printing its help."""
    command = ["-c", form] if form == "import torch" else [HERE / "d3dlo.py", "--help"]
    return seconds(lambda: subprocess.run([sys.executable, *command], check=True,
                                          capture_output=True), 3)


def metric(s, form):
    """Segment errors of as many poses as KITTI's 00 to 10 have."""
    rng, drives = np.random.default_rng(0), []
    for n in KITTI_POSES:
        v = rng.normal([1, 0, 0, 0, 0, 0], [0.1, 0.05, 0.02, 0.1, 0.1, 0.9], (n - 1, 6))
        noise = rng.normal(0, 0.02, v.shape)
        drives.append([d3dlo.accumulate(kitti.from_vector(u)) for u in (v, v + noise)])
    segment_errors = metrics.segment_errors
    if form == "devkit's loops":
        from test_d3dlo import devkit_errors as segment_errors
    return seconds(lambda: [segment_errors(*pair) for pair in drives], 1)


def memory(s, form):
    """Training on as many pairs as KITTI's training split has, reading every record once.

    Returns peak resident memory, the part of it that is not pages of the cache, and the size of
    the cache, in GiB.
    """
    net, (records,), (motions,) = prepare(s, form)
    with tempfile.TemporaryDirectory(dir=".") as folder:
        file = Path(folder, "kitti.npy")
        shape = (KITTI_PAIRS + 1,)
        big = np.lib.format.open_memmap(file, "w+", records.dtype, shape)
        for i in range(0, len(big), len(records)):
            big[i:i + len(records)] = records[:len(big) - i]
        del big
        geometry = [np.load(file, mmap_mode="r")]
        motions = [np.resize(motions, (KITTI_PAIRS, 4, 4))]
        training_steps(net, geometry, motions, d3dlo.steps_per_epoch(motions, CONFIG))
        status = Path("/proc/self/status").read_text()
        peak, own = (int(re.search(rf"{key}:\s*(\d+) kB", status)[1]) / 2**20
                     for key in ("VmHWM", "RssAnon"))
        return peak, own, file.stat().st_size / 2**30


# The table

class Row(NamedTuple):
    """A measurement, its name in the table, and the forms to compare with."""

    measure: Callable
    work: str
    baselines: tuple = ()


ROWS = {
    "fps": Row(fps, "FPS, 1,024 points of a scan, one core",
               ("textbook loop", "fpsample exact", "fpsample buckets")),
    "geometry": Row(geometry, "sampling and grouping, a scan, one core", ("textbook FPS",)),
    "register": Row(register, "Odometry.register, a scan", ("KISS-ICP",)),
    "refine": Row(functools.partial(register, refine=3), "the same, refine=3", ("KISS-ICP",)),
    "training": Row(training, "training step, a pair", ("plain",)),
    "fixed": Row(fixed_statistics, "the same, fixed statistics", ("plain",)),
    "inference": Row(inference, "inference, a pair, geometry given", ("plain",)),
    "cache": Row(cache, "sampling and grouping, a sequence", ("one worker",)),
    "startup": Row(start_up, "d3dlo.py --help", ("import torch",)),
    "metric": Row(metric, "segment errors, 23,201 poses", ("devkit's loops",)),
    "malloc": Row(training, "training step, a pair", ("default malloc",)),
    "compiled": Row(training, "training step, a pair", ("plain compiled", "here compiled")),
    "memory": Row(memory, "memory of training"),
}
VERSIONS = "fps", "geometry", "register", "refine", "training", "fixed", "inference"  # --against
SLOW = "malloc", "compiled", "memory"  # run only if named
PACKAGES = {"fpsample exact": "fpsample", "fpsample buckets": "fpsample", "KISS-ICP": "kiss_icp"}


def in_child(name, form, s, checkout=HERE):
    """Measure in a separate process, with the code of a checkout. Returns the numbers."""
    command = [sys.executable, __file__, "--child", name, form, s.folder.parents[1], s.name]
    done = subprocess.run(command, capture_output=True, text=True,
                          env=os.environ | {"D3DLO_CHECKOUT": str(checkout)})
    if done.returncode:
        sys.exit(f"bench: {name}, {form}, {checkout}:\n{done.stderr}")
    return [float(number) for number in done.stdout.split()]


def child(name, form, root, sequence):
    """Run in the process of `in_child`: measure and print the numbers."""
    print(*np.atleast_1d(ROWS[name].measure(kitti.Sequence(root, sequence), form)))


def compare(name, s, rounds, against=None):
    """Print a line of the table for each baseline, or for another checkout if there is one."""
    forms = [form for form in ROWS[name].baselines
             if form not in PACKAGES or importlib.util.find_spec(PACKAGES[form])]
    works = {form: (form, HERE) for form in forms}
    if against:
        works = {str(against): ("here", against)}
    if not works:
        return
    works["here"] = "here", HERE
    times = np.array([[in_child(name, form, s, checkout)[0] for form, checkout in works.values()]
                      for _ in range(rounds)])  # (rounds,works)
    *medians, here = [f"{1000 * t:.3g} ms" if t < 1 else f"{t:.3g} s"
                      for t in np.median(times, 0)]
    for i, (baseline, median) in enumerate(zip(works, medians)):
        ratio = times[:, i] / times[:, -1]
        print(f"| {ROWS[name].work} | {baseline} {median} | {here} | {np.median(ratio):.2f} | "
              f"{ratio.min():.2f} to {ratio.max():.2f} |", flush=True)


def processor():
    """The name of the processor."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    names = (line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor())


def main():
    """Run the command line."""
    if sys.argv[1:2] == ["--child"]:
        return child(*sys.argv[2:])
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rows", nargs="*", metavar="ROW", help=(
        f"of {', '.join(ROWS)} (default: all but {', '.join(SLOW)}, which take minutes)"))
    parser.add_argument("--data", metavar="ROOT", help=(
        "folder in KITTI odometry layout (default: simulated scans, made in data/bench)"))
    parser.add_argument("--sequence", metavar="NN", help="default: the longest one")
    parser.add_argument("--rounds", type=int, default=5, metavar="N", help="default: 5")
    parser.add_argument("--against", type=Path, metavar="DIR", help=(
        f"compare with another checkout; rows: {', '.join(VERSIONS)}"))
    args = parser.parse_args()
    known = VERSIONS if args.against else ROWS
    rows = args.rows or [name for name in known if name not in SLOW]
    if unknown := set(rows) - set(known):
        parser.error(f"no such row: {', '.join(unknown)}; there are {', '.join(known)}")
    if args.against and not (args.against / "d3dlo.py").is_file():
        parser.error(f"{args.against}: holds no d3dlo.py")
    try:
        root = args.data or kitti.simulate("data/bench", sequences=("00",), scans=100)
        s = max(kitti.open_sequences(root, args.sequence or "all"), key=len)
        if not len(s.motions()):  # ValueError without ground truth
            raise ValueError(f"sequence {s.name} has one scan; two are needed")
    except (ValueError, OSError) as error:
        parser.error(str(error))
    print(f"{processor()}, {kitti.cores()} cores, Python {platform.python_version()}, "
          f"torch {torch.__version__}, numpy {np.__version__}, {time.strftime('%Y-%m-%d')}\n"
          f"sequence {s.name}, {len(s)} scans; {args.rounds} rounds\n\n"
          "| work | baseline | here | ratio, median | ratio, range |\n|---|---|---|---|---|")
    for name in rows:
        if name == "memory":
            peak, own, size = in_child(name, "here", s)
            print(f"training on {KITTI_PAIRS:,} pairs, cache {size:.2f} GiB: peak {peak:.2f} GiB, "
                  f"{own:.2f} GiB of it without the pages of the cache")
        else:
            compare(name, s, args.rounds, args.against and args.against.resolve())


if __name__ == "__main__":
    main()
