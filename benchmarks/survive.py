"""Does an interrupted training run end in the same weights, bit for bit, as an uninterrupted one?

    python benchmarks/survive.py  # 50 interruptions, some 10 minutes of one core
    python benchmarks/survive.py --kills 8

An interruption is kill -9, SIGTERM, Ctrl-C or a write that fails, as on a full disk. It comes at a
random moment: during start-up, while the cache is built (it is sometimes deleted), or while a
checkpoint is written, which happens every half second here. After each interruption every file of
the run must be missing or complete. At the end two training runs start at once without a cache;
their files are read all the time.

Everything happens in a temporary folder. It is kept when a check fails.
"""
import argparse
import collections
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import torch

HERE = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(HERE))
import d3dlo
import kitti

LIMIT = 100_000  # bytes; smaller than weights and cache, so writing these fails
# The command line with frequent checkpoints. The first argument limits the size of files, in bytes;
# 0 is no limit. SIGINT is handled again, since a shell's background job ignores it.
CHILD = f"""
import resource, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
sys.path.insert(0, {str(HERE)!r})
import d3dlo, torch
if __name__ == "__main__":
    torch.set_num_threads(1)
    d3dlo.CHECKPOINT_EVERY, d3dlo.WEIGHTS_EVERY = 0.5, 3
    if limit := int(sys.argv[1]):
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    sys.exit(d3dlo.main(["train", *sys.argv[2:]]))
"""


def start(run, limit=0):
    """Start or resume a training run, in its own process group, as a terminal does."""
    options = ["--data", "drives", "--short", "--batch", "4", "--epochs", "10"]
    if (run / "config.json").exists():
        options = ["--resume"]
    command = [sys.executable, "-c", CHILD, str(limit), "--out", run, *options]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
                            start_new_session=True)


def finish(process, *codes):
    """Wait for a process. Its exit code must be one of `codes`, and there must be no traceback."""
    output, code = process.communicate()[0], process.returncode
    killed = code < 0  # perhaps during an import, which prints a traceback
    if code not in codes or "Traceback" in output and not killed:
        fail(f"exit code {code}, expected one of {codes}:\n{output[-2000:]}")


def fail(what):
    """Exit with a message that says where the files are."""
    sys.exit(f"survive: {what}\nfiles: {Path.cwd()}")


def interrupt(run, rng):
    """Start or resume the training run and interrupt it. Returns the kind, or "finished"."""
    kind = rng.choice(["kill -9", "kill -9", "SIGTERM", "Ctrl-C", "failed write"])
    if kind == "failed write":
        finish(start(run, LIMIT), 2)
        return kind
    process = start(run)
    try:
        process.wait(rng.uniform(0, 12))
        finish(process, 0)
        return "finished"
    except subprocess.TimeoutExpired:
        pass
    if kind == "Ctrl-C":
        os.killpg(process.pid, signal.SIGINT)  # a terminal sends it to the whole group
    else:
        process.send_signal(signal.SIGKILL if kind == "kill -9" else signal.SIGTERM)
    # 0: it was about to end; a signal: kill -9, or Python had not installed its handlers yet
    finish(process, 0, 130, -signal.SIGINT, -signal.SIGTERM, -signal.SIGKILL)
    return kind


def check_complete(run):
    """Check that every file of a training run is missing or complete."""
    try:
        if (run / "config.json").exists():
            d3dlo.read_run(run)
        for path in run.glob("[!.]*.pt"):
            with d3dlo.reading_weights(path):
                d3dlo.read_archive(path)
    except ValueError as error:
        fail(error)


def equal(a, b):
    """Whether the contents of two weights files are the same, bit by bit."""
    if isinstance(a, torch.Tensor):
        return torch.equal(a, b)
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(equal(a[key], b[key]) for key in a)
    if isinstance(a, (list, tuple)):
        return len(a) == len(b) and all(map(equal, a, b))
    return a == b


def check_same(run):
    """Check that the files of a finished training run equal those of the uninterrupted run."""
    for name in ("weights.pt", "checkpoint.pt"):
        if not equal(*(d3dlo.read_archive(folder / name) for folder in (run, Path("alone")))):
            fail(f"{run}/{name} differs from that of the uninterrupted run")


def interrupted_runs(kills, rng):
    """Interrupt training runs `kills` times. Each must end in the same weights."""
    run, counts = Path("interrupted"), collections.Counter()
    while (done := counts.total() - counts["finished"]) < kills:
        if rng.random() < 0.2:
            shutil.rmtree("cache", ignore_errors=True)
        kind = interrupt(run, rng)
        counts[kind] += 1
        print(f"{done + (kind != 'finished')}/{kills}: {kind}", flush=True)
        check_complete(run)
        if kind == "finished":  # compare, then start another run
            check_same(run)
            shutil.rmtree(run)
    finish(start(run), 0)
    check_same(run)
    print("the same weights and optimiser state after "
          + ", ".join(f"{n} {kind}" for kind, n in counts.items()), flush=True)


def two_runs_at_once():
    """Two training runs build the same cache. Their files are read while they are written."""
    shutil.rmtree("cache", ignore_errors=True)
    runs = Path("two/0"), Path("two/1")
    processes = [start(run) for run in runs]
    while any(process.poll() is None for process in processes):
        for run in runs:
            check_complete(run)
        time.sleep(0.02)
    for process, run in zip(processes, runs):
        finish(process, 0)
        check_same(run)
    print("two at once: the same weights; their files were always complete")


def main():
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=50, metavar="N", help=(
        "number of interruptions (default: 50)"))
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="default: 0")
    args = parser.parse_args()
    torch.set_num_threads(1)
    os.chdir(tempfile.mkdtemp(prefix="d3dlo-survive-"))
    kitti.simulate("drives", sequences=("00", "03"), scans=30, azimuth=200)
    finish(start(Path("alone")), 0)
    interrupted_runs(args.kills, random.Random(args.seed))
    two_runs_at_once()
    shutil.rmtree(Path.cwd())


if __name__ == "__main__":
    main()
