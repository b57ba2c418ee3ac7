"""Kill a training again and again, resume it, and compare with one that was left alone: the weights must be the same, bit by bit.

    python benchmarks/survive.py                    # 50 interruptions, some 15 minutes of one core, all in a temporary folder
    python benchmarks/survive.py --kills 5

An interruption is kill -9, SIGTERM, Ctrl-C or a write that fails as on a full disk, at a random moment: among them the start, the building
of the cache, which is deleted now and then, and the writing of a checkpoint, which here happens every half second. After each one, what
is in the run's folder must be whole. At the end two trainings start at once with no cache, and `eval` runs while they write.
"""
import argparse
import json
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
CHILD = f"""
import resource, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)       # a shell's background job would ignore Ctrl-C
sys.path.insert(0, {str(HERE)!r})
import d3dlo, torch
if __name__ == "__main__":
    torch.set_num_threads(1)
    d3dlo.STORE_EVERY = 0.5
    if int(sys.argv[1]):
        resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]), int(sys.argv[1])))
    sys.exit(d3dlo.main(sys.argv[2:]))
"""


def start(arguments, largest_file=0):
    """A process of the command line, in a group of its own as in a terminal; no file of it grows beyond `largest_file` bytes."""
    return subprocess.Popen([sys.executable, "-c", CHILD, str(largest_file), *arguments], stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
                            text=True, start_new_session=True)


def finish(process, *codes):
    """Wait for a process and insist on its exit code and, unless it is 0, on one line of complaint."""
    output = process.communicate()[0]
    if process.returncode not in codes or "Traceback" in output and process.returncode >= 0:      # below 0: while Python imported
        sys.exit(f"survive: exit code {process.returncode}, {codes} expected:\n{output[-2000:]}")
    return output


def interrupt(run, rng):
    """Begin or resume the training, stop it somewhere -> how, or "finished"."""
    how = rng.choice(["kill -9", "kill -9", "SIGTERM", "Ctrl-C", "no more room"])
    resume = ["train", "--out", str(run), "--resume"] if (run / "config.json").exists() else [*TRAIN, "--out", str(run)]
    process = start(resume, 100_000 if how == "no more room" else 0)
    if how == "no more room":
        finish(process, 2)
        return how
    try:
        process.wait(rng.uniform(0, 12))
        finish(process, 0)
        return "finished"
    except subprocess.TimeoutExpired:
        pass
    if how == "Ctrl-C":
        os.killpg(process.pid, signal.SIGINT)           # a terminal sends it to all
    else:
        process.send_signal(signal.SIGKILL if how == "kill -9" else signal.SIGTERM)
    if how == "kill -9":
        process.communicate()
    else:
        finish(process, 0, 130, -signal.SIGINT, -signal.SIGTERM)        # before Python listens, the signal itself ends it
    return how


def whole(run):
    """Everything in a run's folder can be read."""
    for path in run.glob("*.pt"):
        d3dlo.load_weights(path, checkpoint=path.name == "checkpoint.pt")
    if (run / "config.json").exists():
        d3dlo.begun_with(run)


def leftovers(folder):
    """Temporary files."""
    return [path for path in folder.rglob(".*") if path.is_file()]


def same(a, b):
    """The same steps, tensors and random state in two files of weights or checkpoints."""
    x, y = (torch.load(path, weights_only=True) for path in (a, b))

    def equal(u, v):
        if isinstance(u, torch.Tensor):
            return torch.equal(u, v)
        if isinstance(u, dict):
            return u.keys() == v.keys() and all(equal(u[key], v[key]) for key in u)
        if isinstance(u, (list, tuple)):
            return len(u) == len(v) and all(map(equal, u, v))
        return u == v
    return equal(x, y)


def main():
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=50, metavar="N")
    parser.add_argument("--seed", type=int, default=0, metavar="N")
    args = parser.parse_args()
    rng, counts, most = random.Random(args.seed), {}, 0
    os.chdir(tempfile.mkdtemp(prefix="d3dlo-survive-"))
    kitti.simulate("drives", sequences=("00", "03"), scans=30, azimuth=200)
    began = time.monotonic()
    finish(start([*TRAIN, "--out", "alone"]), 0)
    print(f"left alone: {time.monotonic() - began:.0f} s", flush=True)
    run, kills = Path("killed"), 0
    while kills < args.kills:
        if rng.random() < 0.2:
            shutil.rmtree("cache", ignore_errors=True)  # so that it is built again
        how = interrupt(run, rng)
        whole(run)
        if how == "finished":                           # begin another one; the last must end as the first
            if not same(run / "checkpoint.pt", "alone/checkpoint.pt"):
                sys.exit("survive: a resumed training ended in other weights")
            shutil.rmtree(run)
        kills += how != "finished"
        counts[how] = counts.get(how, 0) + 1
        most = max(most, len(leftovers(Path())))
        print(f"{kills}/{args.kills}: {how}", flush=True)
    if not (run / "config.json").exists():
        finish(start([*TRAIN, "--out", str(run)]), 0)
    else:
        finish(start(["train", "--out", str(run), "--resume"]), 0)
    for name in ("checkpoint.pt", "weights.pt"):
        if not same(run / name, f"alone/{name}"):
            sys.exit(f"survive: {name} is not that of the training left alone")
    print(f"the same weights, optimiser and schedule, bit by bit, after {json.dumps(counts)}; at most {most} temporary files, now {len(leftovers(Path()))}")

    shutil.rmtree("cache")
    two, evaluated = [start([*TRAIN, "--out", f"two/{i}"]) for i in range(2)], 0
    while any(process.poll() is None for process in two):
        evaluation = start(["eval", "--data", "drives", "--weights", "two/0", "--out", "evaluated"])
        finish(evaluation, 0, 2)                        # 2: there are no weights yet
        evaluated += evaluation.returncode == 0
    for i, process in enumerate(two):
        finish(process, 0)
        if not same(f"two/{i}/checkpoint.pt", "alone/checkpoint.pt"):
            sys.exit("survive: two at once ended in other weights")
    print(f"two at once: the same weights, and {evaluated} evaluations while they wrote; {len(leftovers(Path()))} temporary files")
    shutil.rmtree(Path.cwd())


if __name__ == "__main__":
    main()
