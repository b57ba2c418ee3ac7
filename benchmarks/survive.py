"""Interrupt a training run again and again, resume it, and compare the weights bit by bit with
those of an uninterrupted run.

    python benchmarks/survive.py  # 50 interruptions, some 15 minutes of one core
    python benchmarks/survive.py --kills 5

An interruption is kill -9, SIGTERM, Ctrl-C or a write that fails, as on a full disk. It comes at a
random moment: during start-up, while the cache is built (it is sometimes deleted), or while a
checkpoint is written, which happens every half second here. After each interruption every file of
the run must be readable. At the end two training runs start at once without a cache, and `eval`
reads their files while they write.

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

TRAIN = ["train", "--data", "drives", "--short", "--batch", "4", "--epochs", "20"]
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
    d3dlo.STORE_EVERY = 0.5
    limit = int(sys.argv[1])
    if limit:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    sys.exit(d3dlo.main(sys.argv[2:]))
"""


def start(arguments, limit=0):
    """Start the command line in its own process group, as a terminal does."""
    command = [sys.executable, "-c", CHILD, str(limit), *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
                            start_new_session=True)


def start_training(run):
    """The arguments that start the training run or, if it has begun, resume it."""
    begun = (run / "config.json").exists()
    return ["train", "--out", str(run), "--resume"] if begun else [*TRAIN, "--out", str(run)]


def finish(process, *codes):
    """Wait for a process. Its exit code must be one of `codes`, and there must be no traceback."""
    output = process.communicate()[0]
    code = process.returncode
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
        finish(start(start_training(run), LIMIT), 2)
        return kind
    process = start(start_training(run))
    try:
        process.wait(rng.uniform(0, 12))
        finish(process, 0)
        return "finished"
    except subprocess.TimeoutExpired:
        pass
    if kind == "kill -9":
        process.kill()
        process.communicate()
        return kind
    if kind == "Ctrl-C":
        os.killpg(process.pid, signal.SIGINT)  # a terminal sends it to the whole group
    else:
        process.terminate()
    # 0: it was about to end; a signal: Python had not installed its handlers yet
    finish(process, 0, 130, -signal.SIGINT, -signal.SIGTERM)
    return kind


def check_readable(run):
    """Check that every file of a training run is missing or complete."""
    try:
        for path in run.glob("*.pt"):
            d3dlo.load_weights(path, checkpoint=path.name == "checkpoint.pt")
        if (run / "config.json").exists():
            d3dlo.read_run(run)
    except ValueError as error:
        fail(error)


def temporary_files():
    """Number of temporary files left."""
    return sum(path.is_file() for path in Path().rglob(".*"))


def equal(a, b):
    """Whether the contents of two weights files are the same, bit by bit."""
    if isinstance(a, torch.Tensor):
        return torch.equal(a, b)
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(equal(a[key], b[key]) for key in a)
    if isinstance(a, (list, tuple)):
        return len(a) == len(b) and all(map(equal, a, b))
    return a == b


def check_same(run, name="checkpoint.pt"):
    """Check that a file of a training run equals that of the uninterrupted run."""
    a, b = (torch.load(folder / name, weights_only=True) for folder in (run, Path("alone")))
    if not equal(a, b):
        fail(f"{run}/{name} differs from that of the uninterrupted run")


def interrupted_runs(kills, rng):
    """Interrupt training runs `kills` times; each must end in the same weights."""
    run, counts, most = Path("interrupted"), collections.Counter(), 0
    while counts.total() - counts["finished"] < kills:
        if rng.random() < 0.2:
            shutil.rmtree("cache", ignore_errors=True)
        kind = interrupt(run, rng)
        counts[kind] += 1
        check_readable(run)
        most = max(most, temporary_files())
        print(f"{counts.total() - counts['finished']}/{kills}: {kind}", flush=True)
        if kind == "finished":  # compare, then start another run
            check_same(run)
            shutil.rmtree(run)
    finish(start(start_training(run)), 0)
    check_same(run)
    check_same(run, "weights.pt")
    print("the same weights and optimiser state after "
          + ", ".join(f"{n} {kind}" for kind, n in counts.items())
          + f"; at most {most} temporary files, now {temporary_files()}", flush=True)


def two_runs_at_once():
    """Two training runs build the same cache while `eval` reads the weights of one of them."""
    shutil.rmtree("cache")
    runs, evaluated = [Path("two", str(i)) for i in range(2)], 0
    processes = [start(start_training(run)) for run in runs]
    while any(process.poll() is None for process in processes):
        evaluation = start(["eval", "--data", "drives", "--weights", str(runs[0]),
                            "--out", "evaluated"])
        finish(evaluation, 0, 2)  # 2: there are no weights yet
        evaluated += evaluation.returncode == 0
    for process, run in zip(processes, runs):
        finish(process, 0)
        check_same(run)
    print(f"two at once: the same weights, {evaluated} evaluations meanwhile; "
          f"{temporary_files()} temporary files")


def main():
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=50, metavar="N", help=(
        "number of interruptions (default: 50)"))
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="default: 0")
    args = parser.parse_args()
    os.chdir(tempfile.mkdtemp(prefix="d3dlo-survive-"))
    kitti.simulate("drives", sequences=("00", "03"), scans=30, azimuth=200)
    began = time.monotonic()
    finish(start(start_training(Path("alone"))), 0)
    print(f"uninterrupted: {time.monotonic() - began:.0f} s", flush=True)
    interrupted_runs(args.kills, random.Random(args.seed))
    two_runs_at_once()
    shutil.rmtree(Path.cwd())


if __name__ == "__main__":
    main()
