"""How fast it is, each piece of work against a baseline in the same run: medians over rounds of the ratio, and its range.

    python benchmarks/bench.py                          # on a few simulated scans
    python benchmarks/bench.py --data ROOT              # on scans in KITTI odometry layout
    python benchmarks/bench.py fps training             # only some rows

The plain forms are those the tests prove the fast ones equal to, so the test packages are needed: pip install ".[test]".
Peers are compared with when they are there: pip install fpsample kiss-icp. Linux only; keep the machine free of other work.
"""
import argparse
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))
import d3dlo
import kitti
import metrics
from d3dlo import Config, accumulate, farthest_point_sampling, load_geometry, scan_geometry, training_batch

CONFIG = Config(augment=True)       # 16 pairs, both directions: 32 directed pairs a batch
KITTI_PAIRS = 15960                 # of the training split


# ---------------------------------------------------------------------------------------------------------------- measuring

def seconds(work):
    """Of one call."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def in_turn(works, rounds):
    """Times works one after the other, `rounds` times over after one that does not count: name -> (rounds,) seconds."""
    for work in works.values():
        work()
    return {name: np.array(times) for name, times in zip(works, zip(*([seconds(w) for w in works.values()] for _ in range(rounds))))}


def row(work, times, unit="ms"):
    """A line of the table for each entry but the baseline (the first). Rounds are compared one by one."""
    base = next(iter(times))
    show = lambda t: f"{np.median(t) * (1000 if unit == 'ms' else 1):.3g} {unit}"
    for name in times:
        if name != base:
            ratio = times[base] / times[name]
            print(f"| {work} | {base} {show(times[base])} | {name} {show(times[name])} | {np.median(ratio):.2f} | "
                  f"{ratio.min():.2f} to {ratio.max():.2f} | {len(ratio)} |", flush=True)


def child(what, form, sequences):
    """Runs this file again for one measurement, with fresh memory and threads -> the numbers it prints."""
    done = subprocess.run([sys.executable, __file__, "--child", what, form, str(sequences[0].folder.parents[1]), *(s.name for s in sequences)],
                          capture_output=True, text=True)
    if done.returncode:
        sys.exit(done.stderr)
    return [float(x) for x in done.stdout.split()]


@contextmanager
def one_core():
    """This thread, and those it starts, stay on one core."""
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    yield
    os.sched_setaffinity(0, cores)


# --------------------------------------------------------------------------------------------------------------------- rows

def plain_fps(xyz, n, start=0):
    """The loop everyone writes, over three contiguous rows."""
    x, y, z = np.ascontiguousarray(xyz.T)
    nearest, picks = np.full(len(x), np.inf, x.dtype), np.full(n, start)
    for i in range(1, n):
        j = picks[i - 1]
        d = np.square(x - x[j])
        d += np.square(y - y[j])
        d += np.square(z - z[j])
        np.minimum(nearest, d, out=nearest)
        picks[i] = nearest.argmax()
    return picks


@one_core()
def fps(sequences):
    """Exact FPS of a scan, one core."""
    for xyz in [np.ascontiguousarray(scan[:, :3]) for scan in some_scans(sequences, 2)]:
        assert (plain_fps(xyz, 1024) == farthest_point_sampling(xyz, 1024)).all()
        works = {"plain loop": lambda: plain_fps(xyz, 1024), "here": lambda: farthest_point_sampling(xyz, 1024)}
        try:
            import fpsample
        except ImportError:
            pass
        else:
            works["fpsample exact"] = lambda: fpsample.fps_sampling(xyz, 1024, start_idx=0)
            works["fpsample buckets"] = lambda: fpsample.bucket_fps_kdline_sampling(xyz, 1024, h=7, start_idx=0)
        times = in_turn(works, 7)
        for base in [name for name in times if name != "here"]:
            row(f"FPS, 1,024 of {len(xyz):,} points, one core", {base: times[base], "here": times["here"]})


@one_core()
def geometry(sequences):
    """Sampling and grouping of a scan, one core: the same with the plain loop for FPS."""
    scan = some_scans(sequences, 1)[0]

    def plain():
        d3dlo.farthest_point_sampling, fast = plain_fps, d3dlo.farthest_point_sampling
        scan_geometry(scan, CONFIG)
        d3dlo.farthest_point_sampling = fast
    row("geometry of a scan, one core", in_turn({"plain FPS": plain, "here": lambda: scan_geometry(scan, CONFIG)}, 9))


def odometry(sequences):
    """Odometry.register, scans in memory, all cores, against KISS-ICP."""
    try:
        from kiss_icp.config import KISSConfig
        from kiss_icp.kiss_icp import KissICP
    except ImportError:
        print("(no KISS-ICP to compare odometry with: pip install kiss-icp)")
        return

    def kiss():
        config = KISSConfig()
        config.data.deskew, config.data.max_range, config.mapping.voxel_size = False, 100.0, 1.0
        method = KissICP(config)
        return lambda scan: method.register_frame(scan[:, :3].astype(np.float64), np.zeros(len(scan)))
    for s in sequences:
        scans = [kitti.read_scan(path) for path in s.scan_paths[:30]]
        times = {"KISS-ICP": [], "here": []}
        for _ in range(3):
            for name, register in ("KISS-ICP", kiss()), ("here", d3dlo.Odometry().register):
                times[name].append(np.median([seconds(lambda: register(scan)) for scan in scans]))
        row(f"odometry, a scan of {s.name}", {name: np.array(t) for name, t in times.items()})


def training(sequences):
    """A training step per pair-step, loader included, all cores; each form in a process of its own."""
    compare_forms("training, a pair-step", "step", sequences, ("plain", "here"), 5)


def compiled(sequences):
    """The same under torch.compile."""
    compare_forms("training, a pair-step", "step", sequences, ("plain", "plain compiled", "here compiled"), 2)


def inference(sequences):
    """Inference per pair, geometry given, all cores."""
    compare_forms("inference, a pair", "infer", sequences, ("plain", "here"), 5)


def compare_forms(work, what, sequences, forms, rounds):
    """A row for the forms of one piece of work, each measured in a process of its own, in turn."""
    times = [[child(what, form, sequences[:1])[0] for form in forms] for _ in range(rounds)]
    row(work, dict(zip(forms, np.array(times).T)))


def cache(sequences):
    """Building the cache, with one worker and with one for each core; and the memory that takes for one and for all sequences."""
    s, cores = sequences[0], kitti.cores()

    def build(n):
        kitti.cores = lambda: n
        with tempfile.TemporaryDirectory() as folder:
            load_geometry([s], CONFIG, folder)
        kitti.cores = lambda: cores
    row(f"cache, {len(s)} scans", in_turn({"1 worker": lambda: build(1), f"{cores} workers": lambda: build(cores)}, 3), "s")
    for some in [sequences[:1]] + [sequences] * (len(sequences) > 1):
        parent, worker = child("cache", "", some)
        print(f"cache, {sum(map(len, some))} scans: peak {parent / 2 ** 20:.2f} GB, a worker {worker / 2 ** 20:.2f} GB")


def memory(sequences):
    """Memory of training on as many pairs as KITTI's training split, from a cache of that size; all of it is read once."""
    peak, anonymous, size = child("memory", "", sequences[:1])
    print(f"training on {KITTI_PAIRS:,} pairs, cache {size / 1e9:.2f} GB: peak resident {peak / 2 ** 20:.2f} GB, of which "
          f"{anonymous / 2 ** 20:.2f} GB memory of its own and the rest pages of the cache")


def startup(sequences):
    """python d3dlo.py --help against importing torch."""
    run = lambda *a: subprocess.run([sys.executable, *a], check=True, capture_output=True)
    row("start-up", in_turn({"import torch": lambda: run("-c", "import torch"), "d3dlo.py --help": lambda: run(HERE.parent / "d3dlo.py", "--help")}, 7), "s")


def metric(sequences):
    """Segment errors of as many poses as KITTI's 00-10 has, against the devkit's loops in plain Python."""
    from test_d3dlo import devkit, motion, perturbed
    rng = np.random.default_rng(0)
    drives = [accumulate(motion(rng, (1.0, 0.05, 0.02, 0.1, 0.1, 0.9), n - 1)) for n in
              (4541, 1101, 4661, 801, 271, 2761, 1101, 1101, 4071, 1591, 1201)]
    pairs = [(T, perturbed(rng, T)) for T in drives]
    row("segment errors, 23,201 poses", in_turn({"devkit's loops": lambda: [devkit(*p) for p in pairs],
                                                 "here": lambda: [metrics.segment_errors(*p) for p in pairs]}, 5), "s")


ROWS = {f.__name__: f for f in (fps, geometry, odometry, training, inference, cache, startup, metric, memory, compiled)}


# ---------------------------------------------------------------------------------------------- one measurement in a process

def child_main(what, form, root, *names):
    """One measurement of `form` ("plain" or "here", both maybe "compiled") on sequences of ROOT -> the numbers."""
    sequences = kitti.open_sequences(root, list(names))
    if what == "cache":
        with tempfile.TemporaryDirectory() as folder:
            load_geometry(sequences, CONFIG, folder)
        return [resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    if form != "plain":                                 # as d3dlo.py train does; the plain form as a plain script runs
        d3dlo.keep_freed_memory()
    geometry, motions = load_geometry(sequences, CONFIG, tempfile.gettempdir() + "/d3dlo-bench"), [s.motions() for s in sequences]
    torch.manual_seed(0)
    net = d3dlo.D3DLO(CONFIG)
    return {"infer": infer, "step": time_steps, "memory": fill_memory}[what](net, forward_of(net, form), geometry, motions)


def forward_of(net, form):
    """Batch -> (B,6) by net's parameters, in one of the forms."""
    forward = net
    if form.startswith("plain"):
        from test_d3dlo import plain
        forward = lambda batch: plain(net, batch)[0]
    if form.endswith("compiled"):
        for function in d3dlo.GatherAdd, d3dlo.LinearMax:       # loops over the batch, which a compiler would unroll
            function.apply = torch.compiler.disable(function.apply)
        forward = torch.compile(forward)
    return forward


def infer(net, forward, geometry, motions):
    """Seconds a pair, of 32."""
    net.eval()
    batch = training_batch(geometry, motions, np.array([(0, i) for i in range(16)]), CONFIG, np.random.default_rng(0))[0]
    with torch.inference_mode():
        return [np.median(in_turn({"": lambda: forward(batch)}, 9)[""]) / len(batch.p)]


def steps(net, forward, geometry, motions, total):
    """Trains on the first 16 of `total` batches and makes the rest; yields the seconds a pair-step of each of the 16."""
    optimizer = torch.optim.Adam(net.parameters())
    last = time.perf_counter()
    for i, (batch, target) in enumerate(d3dlo.batches(geometry, motions, CONFIG, (0,), 0, total)):
        if i < 16:
            loss = d3dlo.loss_unweighted(forward(batch), target)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            yield (time.perf_counter() - last) / len(target)
            last = time.perf_counter()


def time_steps(net, forward, geometry, motions):
    """Seconds a pair-step, loader included, in steady state: the first steps fill the allocator and compile."""
    return [np.median(list(steps(net, forward, geometry, motions, 16))[4:])]


def fill_memory(net, forward, geometry, motions):
    """Peak resident memory and its own share [kB], and the size of the cache [bytes], of training on KITTI_PAIRS pairs."""
    with tempfile.TemporaryDirectory(dir=".") as folder:
        file, n = Path(folder, "kitti.npy"), len(geometry[0])
        big = np.lib.format.open_memmap(file, "w+", geometry[0].dtype, (KITTI_PAIRS + 1,))
        for i in range(0, len(big), n):
            big[i:i + n] = geometry[0][:len(big) - i]
        big.flush()
        del big
        geometry, motions = [np.load(file, mmap_mode="r")], [np.resize(motions[0], (KITTI_PAIRS, 4, 4))]
        list(steps(net, forward, geometry, motions, d3dlo.steps_per_epoch(motions, CONFIG)))
        status = dict(line.split(":") for line in Path("/proc/self/status").read_text().splitlines())
        return [int(status[key].split()[0]) for key in ("VmHWM", "RssAnon")] + [file.stat().st_size]


def some_scans(sequences, n):
    """The middle scan of each of the first n sequences."""
    return [kitti.read_scan(s.scan_paths[len(s) // 2]) for s in sequences[:n]]


def main():
    """The command line."""
    if sys.argv[1:2] == ["--child"]:
        print(*child_main(*sys.argv[2:]))
        return
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rows", nargs="*", metavar="ROW", help=f"of {', '.join(ROWS)} (default: all but the last two, which take minutes)")
    parser.add_argument("--data", metavar="ROOT", help="folder in KITTI odometry layout (default: simulated scans, made in data/bench)")
    parser.add_argument("--sequences", nargs="+", metavar="NN", default="all")
    args = parser.parse_args()
    if unknown := set(args.rows) - set(ROWS):
        parser.error(f"no such row: {', '.join(unknown)}; there are {', '.join(ROWS)}")
    root = args.data or kitti.simulate("data/bench", sequences=("00", "05"), scans=100)
    sequences = sorted(kitti.open_sequences(root, args.sequences), key=len, reverse=True)
    cpu = next((line.split(":")[1].strip() for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name")), platform.processor())
    print(f"{cpu}, {kitti.cores()} cores, torch {torch.__version__}, numpy {np.__version__}, Python {platform.python_version()}, {time.strftime('%Y-%m-%d')}\n"
          f"scans of {root}\n\n| work | baseline | here | ratio, median | ratio, all rounds | rounds |\n|---|---|---|---|---|---|")
    for name in args.rows or [*ROWS][:-2]:
        ROWS[name](sequences)


if __name__ == "__main__":
    main()
