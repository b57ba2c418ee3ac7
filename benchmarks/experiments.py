"""The paper's experiments, from data to a table: our figures beside the paper's.

    python benchmarks/experiments.py table2 --dry-run               # the runs, and the time they will take
    python benchmarks/experiments.py grouping coordinates           # 10,000 pair-steps a run, two seeds, simulated city
    python benchmarks/experiments.py table2 table3 --data ROOT --budget 8000000 --seeds 0 1 2

A pair-step is one pair of scans in one direction. All runs of a table have the same number of them in batches of the same size, the same
data and, seed by seed, the same order of pairs; the recipe is the short one (d3dlo.SHORT). Runs lie in OUT, one folder each, named by what they
depend on: one that is finished is never repeated, one that was interrupted goes on, and tables share them. Each run has one core to itself.
"""
import argparse
import hashlib
import json
import math
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import d3dlo
import kitti
import metrics
from d3dlo import SHORT, Config, Layer

T1 = Config()
QUATERNION = T1.mlp._replace(mlp=(64, 7))
PAPER_2 = {(8, True): (2.19, 0.00855), (16, True): (2.5, 0.01015), (32, True): (2.53, 0.00937), (64, True): (3.63, 0.01483),
           (128, True): (3.04, 0.01172), (8, False): (2.29, 0.00946), (16, False): (2.76, 0.01115), (32, False): (2.28, 0.00969),
           (64, False): (2.52, 0.01057), (128, False): (2.82, 0.01192)}
PAPER_3 = {(8, True): ((3.49, 0.01393), (2.5, 0.01646)), (8, False): ((3.98, 0.01571), (3.89, 0.02563)), (32, False): ((4.32, 0.01642), (4.07, 0.03089))}


def _table_2(n_n, plane):
    return dict(sa1=T1.sa1._replace(n_n=n_n), plane=plane)


def _name_2(n_n, plane):
    return f"n_n = {n_n}, {'with' if plane else 'without'} plane"


# experiment -> variant -> (what differs from the default Config, {split: the paper's E_t [%] and E_r [deg/m]} or its words)
EXPERIMENTS = {
    "grouping": {"nearest n_n": ({}, "open"), "spread over the nearest 8 n_n": (dict(spread=8), "open")},
    "coordinates": {"Table 1": ({}, ""), "coordinates into the mini-PointNet": (dict(coordinates=True), "DeepCLR's")},
    "table2": {_name_2(*key): (_table_2(*key), {"all": paper}) for key, paper in PAPER_2.items()},
    "table3": {_name_2(*key): (_table_2(*key), dict(zip(("test", "validation"), paper))) for key, paper in PAPER_3.items()},
    "loss": {"eq. 2": ({}, "best"), "eq. 2 + eq. 5": (dict(cosine=1.0), "no gain"), "eq. 2 + 0.1 eq. 5": (dict(cosine=0.1), "no gain"),
             "eq. 2 + eq. 5 of the translation": (dict(cosine=1.0, cosine_of="translation"), "no gain"),
             "uncertainty weighting": (dict(uncertainty=True), "no gain")},
    "output": {"Euler angles": ({}, "best"), "quaternion": (dict(mlp=QUATERNION), "no gain"),
               "quaternion, uncertainty weighting": (dict(mlp=QUATERNION, uncertainty=True), "")},
    "scales": {"one scale": ({}, "best"), "two scales in SA1: 1 m and 2 m": (dict(scales=(Layer(2.0, None, 8, (4, 8, 16, 32)),)), "no gain")},
    "swap": {"both directions": ({}, ""), "the paper's coin": (dict(swap="random", batch=2 * SHORT["batch"]), "used"),
             "forward only": (dict(swap="off", batch=2 * SHORT["batch"]), "")},
}


def splits_of(name):
    """What an experiment is measured on."""
    return {"table2": ("all",), "table3": ("test", "validation")}.get(name, ("test",))


def pair_steps(config, pairs):
    """Of a whole training."""
    return config.epochs * pairs * (2 if config.swap == "both" else 1)


def config_of(changes, pairs, budget):
    """The short recipe, as many epochs as the budget holds, and at least one over both directions."""
    config = replace(Config(**SHORT), **changes)
    return replace(config, epochs=max(1, round(budget / (2 * pairs))) * (1 if config.swap == "both" else 2))


def folder_of(out, config, seed, chosen, everything):
    """Where a run lies: named by all it depends on, the data included."""
    depends = config.as_dict(), seed, d3dlo.GEOMETRY, [s.name for s in chosen], [d3dlo.fingerprint(s) for s in everything]
    return out / hashlib.sha256(json.dumps(depends, sort_keys=True).encode()).hexdigest()[:12]


def seconds_a_step(config):
    """One core's time for a pair-step, timed on random points."""
    torch.set_num_threads(1)
    rng, records = np.random.default_rng(0), np.zeros(config.batch + 1, d3dlo.geometry_dtype(config))
    records["xyz"] = rng.normal(size=records["xyz"].shape) * 20
    records["group"] = rng.normal(size=records["group"].shape)
    for name, layer in ("idx2", config.sa1), ("idx3", config.sa2):
        records[name] = rng.integers(layer.n_fps, size=records[name].shape)
    motions = [np.tile(np.eye(4), (config.batch, 1, 1))]
    net, objective, times = d3dlo.D3DLO(config), d3dlo.Objective(config), []
    for _ in range(2):
        start = time.perf_counter()
        batch, target = d3dlo.training_batch([records], motions, [(0, i) for i in range(config.batch)], config, rng)
        objective(net(batch), target).backward()
        times.append(time.perf_counter() - start)
    return min(times) / len(target)


def run_one(run, config, root, sequences, evaluated, seed):
    """One training and its evaluation, in a process of its own with one thread."""
    job = json.dumps(dict(run=str(run), config=config.as_dict(), root=str(root), sequences=sequences, evaluated=evaluated, seed=seed))
    run.mkdir(parents=True, exist_ok=True)
    with open(run / "output.txt", "a") as log:
        done = subprocess.run([sys.executable, __file__, "--child", job], stdout=log, stderr=subprocess.STDOUT,
                              env=os.environ | {"OMP_NUM_THREADS": "1"})
    if done.returncode:
        raise RuntimeError(f"{run}: failed, see {run}/output.txt")


def child(run, config, root, sequences, evaluated, seed):
    """What `run_one` runs: train, or go on, and evaluate."""
    torch.set_num_threads(1)
    d3dlo.keep_freed_memory()
    d3dlo.train(Config(**config), root, sequences, run, seed=seed, resume=(Path(run) / "config.json").exists())
    d3dlo.evaluate(root, run, evaluated, out=Path(run) / "all")


def figures(run, split):
    """E_t, E_r, t step, r step of a run on a split."""
    results = json.loads((run / "all" / "results.json").read_text())
    result = (results["splits"] | {"all": results["pooled"]})[split]
    return [result[key] if result[key] is not None else math.nan for key in ("E_t", "E_r", "t_step_m", "r_step_deg")]


def table(name, variants, runs, out, caption):
    """The Markdown table of an experiment; mean over the seeds, and their range when there are several."""
    header = ["", "split", "parameters", "paper's E_t [%]", "paper's E_r [deg/m]", "E_t [%]", "E_r [deg/m]", "t step [m]", "r step [deg]"]
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    for variant, (_, paper) in variants.items():
        config = runs[variant][0][0]
        parameters = sum(p.numel() for p in d3dlo.D3DLO(config).parameters())
        for split in splits_of(name):
            seeds = np.array([figures(run, split) for _, run, _ in runs[variant]])     # (seeds,4)
            cells = ["-" if np.isnan(c).any() else f"{c.mean():.{digits}f}" + (f" ({c.min():.{digits}f} to {c.max():.{digits}f})" if len(c) > 1 else "")
                     for c, digits in zip(seeds.T, (3, 5, 4, 4))]
            theirs = [f"{paper[split][0]}", f"{paper[split][1]:.5f}"] if isinstance(paper, dict) else [paper, ""]
            lines.append("| " + " | ".join([variant, split, f"{parameters:,}", *theirs, *cells]) + " |")
    text = f"# {name}\n\n" + "\n".join(lines) + f"\n\n{caption}\n"
    with metrics.replacing(out / f"{name}.md") as temporary:
        temporary.write_text(text, encoding="utf-8")
    print(f"\n{text}\n{out}/{name}.md")


def dry_run(runs, todo, steps, jobs):
    """Say which runs of `todo` each experiment needs, and how long they take; what two of them share is counted once."""
    cost, left, total = {}, dict(todo), 0
    for name, variants in runs.items():
        for variant, some in variants.items():
            for config, run, seed in some:
                if left.pop(run, None):
                    cost[config] = cost.get(config) or seconds_a_step(config)
                    total += cost[config] * steps
                    print(f"{name}: {variant}, seed {seed}: {cost[config] * steps / 60:.0f} minutes of one core -> {run}", flush=True)
    print(f"{total / 3600 / jobs:.1f} hours with {jobs} at a time, and the caches")


def train_all(todo, root, sequences, evaluated, jobs):
    """`jobs` runs at a time, each in its own process."""
    pool = ThreadPoolExecutor(jobs)
    try:
        runs = [pool.submit(run_one, run, config, root, sequences, evaluated, seed) for run, (config, seed) in todo.items()]
        for run in kitti.progress(runs, len(runs), "trainings"):
            run.result()
    finally:                                            # an interruption, or a run that failed: start no other
        pool.shutdown(cancel_futures=True)


def main():
    """The command line."""
    if sys.argv[1:2] == ["--child"]:
        child(**json.loads(sys.argv[2]))
        return 0
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("experiments", nargs="+", choices=EXPERIMENTS, metavar="NAME", help=f"of {', '.join(EXPERIMENTS)}")
    parser.add_argument("--data", metavar="ROOT", help=f"folder in KITTI odometry layout (default: the simulated city, {d3dlo.SIMULATED})")
    parser.add_argument("--sequences", nargs="+", default=["train"], metavar="NN", help="to train on (default: train)")
    parser.add_argument("--budget", type=int, default=10000, metavar="N", help="pair-steps of a training (default: 10,000; the paper's is some 8,000,000)")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1], metavar="N")
    parser.add_argument("--jobs", type=int, default=kitti.cores(), metavar="N", help="trainings at a time (default: one for each core)")
    parser.add_argument("--out", type=Path, default=Path("runs/experiments"), metavar="DIR")
    parser.add_argument("--dry-run", action="store_true", help="list the runs and the time they will take")
    args = parser.parse_args()
    d3dlo.keep_freed_memory()
    root = Path(args.data) if args.data else kitti.simulate(d3dlo.SIMULATED)
    everything = [s for s in kitti.open_sequences(root) if s.poses is not None]
    chosen, names = kitti.open_sequences(root, args.sequences), [s.name for s in everything]
    for split in {split for name in args.experiments for split in splits_of(name)} - {"all"}:
        if not set(kitti.SPLITS[split]) & set(names):
            parser.error(f"{root}: none of the sequences of the {split} split ({' '.join(kitti.SPLITS[split])}), on which the table is measured")
    pairs = sum(len(s.motions()) for s in chosen)

    runs = {name: {variant: [(config, folder_of(args.out, config, seed, chosen, everything), seed) for seed in args.seeds
                             for config in [config_of(changes, pairs, args.budget)]]
                   for variant, (changes, _) in EXPERIMENTS[name].items()} for name in args.experiments}
    every = {run: (config, seed) for variants in runs.values() for some in variants.values() for config, run, seed in some}
    todo = {run: job for run, job in every.items() if not (run / "all" / "results.json").exists()}
    steps = pair_steps(next(iter(every.values()))[0], pairs)
    records = {(d3dlo.geometry_dtype(c), c.plane, c.spread) for c, _ in todo.values()}
    print(f"{len(every)} runs, {len(every) - len(todo)} of them finished; {pairs:,} pairs of {root}, {steps:,} pair-steps a run; "
          f"caches of {sum(dtype.itemsize for dtype, *_ in records) * sum(map(len, everything)) / 1e9:.1f} GB", flush=True)
    if args.dry_run:
        dry_run(runs, todo, steps, args.jobs)
        return 0
    for config in dict.fromkeys(config for config, _ in todo.values()):     # caches first, with all cores
        d3dlo.load_geometry(everything, config)
    train_all(todo, root, [s.name for s in chosen], names, args.jobs)
    repeat = [*(["--data", args.data] if args.data else []), *(["--sequences", *args.sequences] if args.sequences != ["train"] else []),
              "--budget", str(args.budget), "--seeds", *map(str, args.seeds)]
    for name, variants in runs.items():
        table(name, EXPERIMENTS[name], variants, args.out, (
            f"{'Simulated city' if not args.data else root}: trained on sequences {' '.join(s.name for s in chosen)} ({pairs:,} pairs), "
            f"{steps:,} pair-steps a run (the paper's are some 8 million) by the short recipe, seeds {' '.join(map(str, args.seeds))}; "
            f"mean over the seeds, their range in brackets. Made by `{' '.join(['python benchmarks/experiments.py', name, *repeat])}`."))
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (ValueError, OSError, RuntimeError) as error:
        sys.exit(f"experiments: {error}")
    except KeyboardInterrupt:
        sys.exit("\nexperiments: interrupted; the same command goes on from here")
