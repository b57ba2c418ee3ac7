"""Run the paper's experiments and print our figures beside the paper's.

    python benchmarks/experiments.py table2 --dry-run      # list the runs and estimate their time
    python benchmarks/experiments.py loss coordinates      # simulated city, 10,000 pair-steps a run
    python benchmarks/experiments.py table2 table3 --data ROOT --budget 8000000 --seeds 0 1 2

The first half holds what the paper tried and rejected, as losses and as subclasses of D3DLO. They
are passed to `d3dlo.train` as its `objective` and its `network`.

A pair-step is one pair of scans, in one direction, in one training step. All runs of a table have
the same number of pair-steps, the same batch size, the same data and, for the same seed, the same
order of pairs. The recipe is the short one, d3dlo.SHORT.

Every run has a folder in OUT, named by a hash of everything it depends on. Finished runs are not
repeated, interrupted ones are resumed, and tables share runs. Each run uses one core.
"""
import argparse
import hashlib
import json
import math
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from scipy import stats
from scipy.spatial.transform import Rotation
from torch import nn

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import d3dlo
import kitti
import metrics
from d3dlo import D3DLO, SHORT, Config, FlowEmbedding, MiniPointNet, UnweightedLoss

# ------------------------------------------------------------------------------------------------
# Losses: section 3.4, and section 3.2 on uncertainty


class CosineLoss(nn.Module):
    """Eq. 2 + weight * eq. 5 of the first n outputs. The first three are the translation."""

    def __init__(self, weight, n=6):
        super().__init__()
        self.weight, self.n = weight, n

    def extra_repr(self):
        return f"weight={self.weight}, n={self.n}"

    def forward(self, y_hat, y):
        """Predictions and targets (B,6), (B,6) -> the loss ()."""
        # Eq. 5 is not defined for a zero vector. `eps` replaces lengths below 0.001.
        cosine = F.cosine_similarity(y_hat[:, :self.n], y[:, :self.n], eps=1e-3)  # (B,)
        return (y - y_hat).abs().mean() + self.weight * (1 - cosine).mean()


class UncertaintyLoss(nn.Module):
    """Homoscedastic uncertainty weighting (Kendall and Cipolla 2017), with learned s = log sigma^2:
    exp(-s_t) L_t + s_t + exp(-s_r) L_r + s_r for the errors L of translation and rotation.
    """

    def __init__(self):
        super().__init__()
        self.log_variance = nn.Parameter(torch.zeros(2))  # s_t, s_r

    def forward(self, y_hat, y):
        """(B,D), (B,D) -> (). The first three outputs are the translation."""
        error = (y - y_hat).abs()
        errors = torch.stack([error[:, :3].mean(), error[:, 3:].mean()])
        return (torch.exp(-self.log_variance) * errors + self.log_variance).sum()


class QuaternionLoss(nn.Module):
    """A loss for quaternions. q and -q are the same rotation, so the target is the nearer one."""

    def __init__(self, loss):
        super().__init__()
        self.loss = loss

    def forward(self, y_hat, y):
        """(B,7), (B,7) -> ()."""
        t, q = y[:, :3], y[:, 3:]
        opposite = (y_hat[:, 3:] * q).sum(1, keepdim=True) < 0  # (B,1)
        return self.loss(y_hat, torch.cat([t, torch.where(opposite, -q, q)], 1))


# ------------------------------------------------------------------------------------------------
# Networks


class Quaternion(D3DLO):
    """Section 3.2: the rotation as a unit quaternion x, y, z, w. 61,355 parameters."""

    @staticmethod
    def encode(T):
        """Poses (...,4,4) -> metres and quaternions (...,7)."""
        return np.concatenate([T[..., :3, 3], Rotation.from_matrix(T[..., :3, :3]).as_quat()], -1)

    @staticmethod
    def decode(y):
        """The inverse of `encode`."""
        T = np.tile(np.eye(4), (*y.shape[:-1], 1, 1))
        T[..., :3, 3] = y[..., :3]
        T[..., :3, :3] = Rotation.from_quat(y[..., 3:]).as_matrix()
        return T

    def __init__(self, config=Config()):
        super().__init__(config)
        self.mlp[-1] = nn.Linear(self.mlp[-1].in_features, 7)

    def forward(self, batch):
        """Batch -> y_hat (B,7)."""
        y_hat = super().forward(batch)
        return torch.cat([y_hat[:, :3], F.normalize(y_hat[:, 3:])], 1)


class TwoBalls(nn.Module):
    """Multi-scale grouping, section 3.3.2: a MiniPointNet for a ball, and one for half its radius.

    On a surface half the radius holds a quarter of the points, so the small ball gets a quarter of
    the neighbours. They come nearest first: the small ball is the beginning of the large one.
    """

    def __init__(self, c, layer):
        super().__init__()
        self.r, self.n_n = layer.r / 2, max(1, layer.n_n // 4)  # of the small ball
        self.small = MiniPointNet(c, layer.widths)
        self.large = MiniPointNet(c, layer.widths)

    def forward(self, f):
        """Features of neighbours (C,S,k,c), the last three x_i - x'_j -> (C,S,2c')."""
        small = f[:, :, :self.n_n]
        inside = small[..., -3:].norm(dim=-1, keepdim=True) <= self.r  # (C,S,n_n,1)
        small = torch.where(inside, small, f[:, :, :1])  # missing ones are the centroid
        return torch.cat([self.small(small), self.large(f)], -1)


class TwoScales(D3DLO):
    """Multi-scale grouping in the first set abstraction. 64,206 parameters."""

    def __init__(self, config=Config()):
        super().__init__(config)
        self.sa1.mpn = TwoBalls(1 + 3, config.sa1)  # intensity and x_i - x'_j
        self.fe = FlowEmbedding(2 * config.sa1.widths[-1], config.fe)


class AppendCoordinates(nn.Module):
    """A set abstraction, and the coordinates of its centroids appended to their features."""

    def __init__(self, sa):
        super().__init__()
        self.sa = sa

    def forward(self, x, f, idx):
        """x (B,n,3), f (B,n,c), idx (B,S,k) -> (B,S,c'+3), the coordinates in tens of metres."""
        f = self.sa(x, f, idx)
        return torch.cat([f, x[:, :f.shape[1]] / 10], -1)


class Coordinates(D3DLO):
    """Not in the paper but in DeepCLR: the mini-PointNet sees where its 64 points are.

    61,482 parameters.
    """

    def __init__(self, config=Config()):
        super().__init__(config)
        self.sa3 = AppendCoordinates(self.sa3)
        self.mpn = MiniPointNet(config.sa3.widths[-1] + 3, config.mpn.widths)


# ------------------------------------------------------------------------------------------------
# Experiments


class Variant(NamedTuple):
    """A row of a table, or one row for each split of the experiment."""

    paper: str | dict = ""  # the paper's words, or {split: its E_t [%] and E_r [deg/m]}
    changes: dict = {}  # what differs from Config(**SHORT)
    network: type = D3DLO
    objective: Callable[[], nn.Module] = UnweightedLoss


T1 = Config()
RANDOM = dict(swap="random", batch=2 * SHORT["batch"])  # a batch has as many pair-steps as "both"
TWO_SCALES = dict(sa1=T1.sa1._replace(r=2.0, n_n=4 * T1.sa1.n_n))  # 1 m, 8; 2 m, 32
PAPER_2 = {  # n_n and plane -> E_t, E_r
    (8, True): (2.19, 0.00855), (16, True): (2.5, 0.01015), (32, True): (2.53, 0.00937),
    (64, True): (3.63, 0.01483), (128, True): (3.04, 0.01172),
    (8, False): (2.29, 0.00946), (16, False): (2.76, 0.01115), (32, False): (2.28, 0.00969),
    (64, False): (2.52, 0.01057), (128, False): (2.82, 0.01192)}
PAPER_3 = {  # n_n and plane -> E_t, E_r of the test split; of the validation split
    (8, True): ((3.49, 0.01393), (2.5, 0.01646)),
    (8, False): ((3.98, 0.01571), (3.89, 0.02563)),
    (32, False): ((4.32, 0.01642), (4.07, 0.03089))}
SPLITS = {"table2": ("all",), "table3": ("test", "validation")}  # all others: test


def row_of_table_2(n_n, plane, paper):
    """The name and the Variant of a combination of n_n and plane."""
    name = f"n_n = {n_n}, {'with' if plane else 'without'} plane"
    return name, Variant(paper, dict(sa1=T1.sa1._replace(n_n=n_n), plane=plane))


EXPERIMENTS = {
    "table2": dict(row_of_table_2(*key, {"all": paper}) for key, paper in PAPER_2.items()),
    "table3": dict(row_of_table_2(*key, dict(zip(SPLITS["table3"], paper)))
                   for key, paper in PAPER_3.items()),
    "loss": {
        "eq. 2": Variant("best"),
        "eq. 2 + eq. 5": Variant("no gain", objective=lambda: CosineLoss(1.0)),
        "eq. 2 + 0.1 eq. 5": Variant("no gain", objective=lambda: CosineLoss(0.1)),
        "eq. 2 + eq. 5 of the translation":
            Variant("no gain", objective=lambda: CosineLoss(1.0, n=3)),
        "uncertainty weighting": Variant("no gain", objective=UncertaintyLoss)},
    "output": {
        "Euler angles": Variant("best"),
        "quaternion": Variant("no gain", {}, Quaternion, lambda: QuaternionLoss(UnweightedLoss())),
        "quaternion, uncertainty weighting":
            Variant("", {}, Quaternion, lambda: QuaternionLoss(UncertaintyLoss()))},
    "scales": {
        "one scale": Variant("best"),
        "two scales in SA1: 1 m and 2 m": Variant("no gain", TWO_SCALES, TwoScales)},
    "coordinates": {
        "Table 1": Variant(),
        "coordinates into the mini-PointNet": Variant("DeepCLR's", network=Coordinates)},
    "swap": {
        "both directions": Variant(),
        "one direction at random": Variant("used", RANDOM)},
}


def splits_of(experiment):
    """The splits an experiment is measured on."""
    return SPLITS.get(experiment, ("test",))


# ------------------------------------------------------------------------------------------------
# Runs


class Run(NamedTuple):
    """One training run and its evaluation."""

    experiment: str
    variant: str  # EXPERIMENTS[experiment][variant]
    config: Config
    seed: int
    folder: Path

    def finished(self):
        """Whether its results are there."""
        results = self.folder / "all" / "results.json"
        return results.exists() and "pooled" in json.loads(results.read_text(encoding="utf-8"))


def pair_steps(config, pairs):
    """Number of pair-steps of a whole training run."""
    return config.epochs * pairs * (2 if config.swap == "both" else 1)


def config_of(changes, pairs, budget):
    """The short recipe with changes. The budget determines the number of epochs, at least one over
    both directions.
    """
    config = replace(Config(**SHORT), **changes)
    epochs = max(1, round(budget / (2 * pairs)))
    return replace(config, epochs=epochs if config.swap == "both" else 2 * epochs)


def fingerprint(sequence):
    """A hash that identifies the data of a sequence, the same on every machine.

    Of each scan, only the size and the first 256 points are hashed.
    """
    digest = hashlib.sha256(sequence.Tr.tobytes() + sequence.poses_cam.tobytes())
    for path in sequence.scan_paths:
        with open(path, "rb") as file:
            digest.update(str(path.stat().st_size).encode() + file.read(4096))
    return digest.hexdigest()


def plan(experiments, pairs, budget, seeds, out, data):
    """{experiment: {variant: [a Run for each seed]}}. data: identifies the data; fit for JSON."""
    def run(experiment, name, seed):
        variant = EXPERIMENTS[experiment][name]
        config = config_of(variant.changes, pairs, budget)
        depends = (config.as_dict(), variant.network.__name__, repr(variant.objective()), seed,
                   d3dlo.GEOMETRY_VERSION, data)
        key = hashlib.sha256(json.dumps(depends, sort_keys=True).encode()).hexdigest()[:12]
        return Run(experiment, name, config, seed, out / key)

    return {experiment: {name: [run(experiment, name, seed) for seed in seeds]
                         for name in EXPERIMENTS[experiment]} for experiment in experiments}


def seconds_a_step(config):
    """Estimate the seconds that one core needs for a pair-step.

    Measured with two runs at a time on the two cores of a Xeon: 26 ms with the 8 neighbours of
    Table 1, 38 ms with 32, 49 ms with 64 and 74 ms with 128, and 37 ms with two scales.
    """
    return 0.023 + 0.0004 * config.sa1.n_n


# ------------------------------------------------------------------------------------------------
# Caches: configurations that differ in n_n of SA1 alone share one


class Nearest:
    """The records of a sequence as those of a `config` with fewer neighbours in SA1.

    The neighbours are in order of distance, so the nearest ones are the first ones.
    """

    def __init__(self, records, config):
        self.records, self.n_n = records, config.sa1.n_n
        self.dtype = d3dlo.geometry_dtype(config)

    def __len__(self):
        return len(self.records)

    def __getitem__(self, key):
        """The record of a scan, the records of a slice of scans, or all values of a field."""
        if isinstance(key, str):
            return self.narrow(self.records, key)
        wide = self.records[key]
        records = np.zeros(wide.shape, self.dtype)
        for name in self.dtype.names:
            records[name] = self.narrow(wide, name)
        return records

    def narrow(self, wide, name):
        """The values of a field of wide records, with the first n_n neighbours of SA1 only."""
        return wide[name][..., :self.n_n, :] if name == "group_sa1" else wide[name]


def widest(config, configs):
    """The Config among `configs` whose cache serves `config`: the one with the largest n_n."""
    def settings(c):
        return c.sa1._replace(n_n=None), c.sa2, c.sa3, c.plane, c.max_range

    alike = [c for c in configs if settings(c) == settings(config)]
    return max(alike, key=lambda c: c.sa1.n_n)


def share_cache(n_n):
    """Make `d3dlo.load_geometry` read caches with n_n neighbours in SA1, for any fewer."""
    load = d3dlo.load_geometry

    def load_nearest(sequences, config, cache="cache"):
        wide = replace(config, sa1=config.sa1._replace(n_n=n_n))
        geometry, fingerprints = load(sequences, wide, cache)
        return [Nearest(records, config) for records in geometry], fingerprints

    d3dlo.load_geometry = load_nearest


CHILDREN = set()  # the processes of training runs under way


def run_one(run, root, sequences, evaluated, cache_n_n):
    """Train and evaluate in a separate process. Raises RuntimeError if that fails."""
    job = dict(experiment=run.experiment, variant=run.variant, config=run.config.as_dict(),
               seed=run.seed, folder=str(run.folder), root=str(root), sequences=sequences,
               evaluated=evaluated, cache_n_n=cache_n_n)
    run.folder.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, __file__, "--child", json.dumps(job)]
    one_thread = os.environ | {"OMP_NUM_THREADS": "1"}
    with open(run.folder / "output.txt", "a", encoding="utf-8") as log:
        child = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, env=one_thread)
    CHILDREN.add(child)
    code = child.wait()
    CHILDREN.remove(child)
    if code:
        raise RuntimeError(f"{run.folder}: failed, see {run.folder}/output.txt")


def run_child(experiment, variant, config, seed, folder, root, sequences, evaluated, cache_n_n):
    """Start or resume a training run, then evaluate: the process that `run_one` starts."""
    torch.set_num_threads(1)
    kitti.keep_freed_memory()
    kitti.treat_sigterm_as_interrupt()
    share_cache(cache_n_n)
    variant, folder = EXPERIMENTS[experiment][variant], Path(folder)
    d3dlo.train(Config(**config), root, sequences, folder, seed, network=variant.network,
                objective=variant.objective(), resume=(folder / "config.json").exists())
    d3dlo.evaluate(root, folder, evaluated, folder / "all", network=variant.network)


def stop_children(number, frame):
    """Pass SIGTERM on to the children. Ctrl-C in a terminal reaches them anyway."""
    for child in list(CHILDREN):
        child.terminate()
    raise KeyboardInterrupt


def run_all(todo, root, sequences, evaluated, configs, jobs):
    """Execute a list of Runs, `jobs` at a time. configs: of all Runs, also the finished ones."""
    pool = ThreadPoolExecutor(jobs)
    try:
        futures = [pool.submit(run_one, run, root, sequences, evaluated,
                               widest(run.config, configs).sa1.n_n) for run in todo]
        for future in kitti.progress(futures, len(futures), "training runs"):
            future.result()
    finally:  # start no further run after an interruption or a failure
        pool.shutdown(cancel_futures=True)


def dry_run(todo, steps, scans, configs, jobs):
    """Print a list of Runs, about how long they take, and how large the caches of all are."""
    total = 0
    for run in todo:
        seconds = steps * seconds_a_step(run.config)
        total += seconds
        print(f"{run.experiment}: {run.variant}, seed {run.seed}: {seconds / 60:.0f} minutes "
              "of one core")
    size = sum(d3dlo.geometry_dtype(c).itemsize for c in configs if c == widest(c, configs))
    print(f"{total / 3600 / jobs:.1f} hours with {jobs} at a time, and the time to make caches of "
          f"{scans * size / 1e9:.1f} GB")


# ------------------------------------------------------------------------------------------------
# Tables

HEADER = ["", "split", "parameters", "paper's E_t [%]", "paper's E_r [deg/m]",
          "E_t [%]", "E_r [deg/m]", "t step [m]", "r step [deg]"]
DIGITS = {"E_t": 3, "E_r": 5, "t_step_m": 4, "r_step_deg": 4}  # after the decimal point


def figures(run, split):
    """E_t, E_r, t step and r step of a Run on a split, a dict. NaN without a segment or split."""
    results = json.loads((run.folder / "all" / "results.json").read_text(encoding="utf-8"))
    result = results["pooled"] if split == "all" else results["splits"].get(split, {})
    return {key: math.nan if result.get(key) is None else result[key] for key in DIGITS}


def figures_of_seeds(experiment, runs):
    """{variant: {split: {figure: [its value for each seed]}}} of the Runs of an experiment."""
    table = {}
    for name, of_seeds in runs.items():
        table[name] = {}
        for split in splits_of(experiment):
            each = [figures(run, split) for run in of_seeds]
            table[name][split] = {key: [values[key] for values in each] for key in DIGITS}
    return table


def cell(values, digits):
    """Format the mean over the seeds and, if there are several, their range."""
    values = np.array(values)
    if np.isnan(values).any():
        return "-"
    mean, low, high = (f"{x:.{digits}f}" for x in (values.mean(), values.min(), values.max()))
    return mean if len(values) == 1 else f"{mean} ({low} to {high})"


def join_cells(lines):
    """Lists of cells -> a table in Markdown."""
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def markdown(experiment, runs, measured, words):
    """The table of an experiment in Markdown, followed by `words`.

    measured: the result of `figures_of_seeds`.
    """
    lines = [HEADER, ["---"] * len(HEADER)]
    for name, splits in measured.items():
        variant = EXPERIMENTS[experiment][name]
        net = variant.network(runs[name][0].config)
        parameters = f"{sum(p.numel() for p in net.parameters()):,}"
        for split, values in splits.items():
            paper = [variant.paper, ""]
            if isinstance(variant.paper, dict):
                E_t, E_r = variant.paper[split]
                paper = [f"{E_t}", f"{E_r:.5f}"]
            ours = [cell(values[key], digits) for key, digits in DIGITS.items()]
            lines.append([name, split, parameters, *paper, *ours])
    return f"# {experiment}\n\n{join_cells(lines)}\n\n{words}\n"


def effects(rows, split):
    """The effects of the plane and of n_n on each figure, estimated from all Runs of Table 2.

    Least squares: figure = a + b [1 with the plane, 0 without] + c log2(n_n). Returns b and c, and
    half the widths of their 95 % confidence intervals (Student's t): (2,4), (2,4).
    """
    runs = [run for of_seeds in rows.values() for run in of_seeds]
    factors = [[1, run.config.plane, np.log2(run.config.sa1.n_n)] for run in runs]
    X = np.array(factors, float)  # (n,3)
    Y = np.array([list(figures(run, split).values()) for run in runs])  # (n,4)
    coefficients = np.linalg.pinv(X) @ Y  # (3,4)
    squares, freedom = ((Y - X @ coefficients) ** 2).sum(0), len(X) - 3
    variances = np.linalg.inv(X.T @ X).diagonal()[:, None] * squares / freedom  # (3,4)
    half_widths = stats.t.ppf(0.975, freedom) * np.sqrt(variances)
    return coefficients[1:], half_widths[1:]


def effects_in_markdown(rows):
    """The table of `effects` on the test split and on all sequences."""
    lines = [["effect, with its 95 % confidence interval", "split", *HEADER[-4:]], ["---"] * 6]
    for split in ("test", "all"):
        for name, *row in zip(("the plane", "twice the neighbours"), *effects(rows, split)):
            cells = ["-" if np.isnan(value) else f"{value:+.{digits}f} ± {half_width:.{digits}f}"
                     for value, half_width, digits in zip(*row, DIGITS.values())]
            lines.append([name, split, *cells])
    return join_cells(lines)


def write_table(experiment, runs, out, words):
    """Write OUT/EXPERIMENT.md and print it. OUT/EXPERIMENT.json holds the figures of each seed."""
    measured = figures_of_seeds(experiment, runs)
    text, path = markdown(experiment, runs, measured, words), out / f"{experiment}.md"
    metrics.write_json(out / f"{experiment}.json", measured)
    with metrics.replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    print(f"\n{text}\n{path}")


# ------------------------------------------------------------------------------------------------
# The command line


def command_line():
    """Parse the arguments."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("experiments", nargs="+", choices=EXPERIMENTS, metavar="NAME", help=", ".join(EXPERIMENTS))
    add("--data", metavar="ROOT",
        help=f"folder in KITTI odometry layout (default: the simulated city, {d3dlo.SIMULATED})")
    add("--sequences", nargs="+", default=["train"], metavar="NN",
        help="names or splits to train on (default: train)")
    add("--budget", type=int, default=10000, metavar="N",
        help="pair-steps of a training run (default: 10,000; the paper's have some 8,000,000)")
    add("--seeds", nargs="+", type=int, default=[0, 1], metavar="N", help="default: 0 1")
    add("--jobs", type=int, default=kitti.cores(), metavar="N",
        help="training runs at a time (default: one for each core)")
    add("--out", type=Path, default=Path("runs/experiments"), metavar="DIR",
        help="folder of the runs and tables (default: runs/experiments)")
    add("--dry-run", action="store_true", help="list the runs and estimate their time")
    return parser.parse_args()


def caption(experiment, args, trained, pairs, steps):
    """The line below a table: what was run, and the command that makes the table again."""
    seeds = " ".join(map(str, args.seeds))
    command = ["python benchmarks/experiments.py", experiment]
    if args.data:
        command += ["--data", args.data]
    if args.sequences != ["train"]:
        command += ["--sequences", *args.sequences]
    command += ["--budget", f"{args.budget}", "--seeds", seeds]
    return (f"{args.data or 'Simulated city'}: trained on sequences {' '.join(trained)} "
            f"({pairs:,} pairs), {steps:,} pair-steps a run (the paper's have some 8 million), "
            f"short recipe, seeds {seeds}; mean over the seeds, their range in brackets. "
            f"Made by `{' '.join(command)}`.")


def check_splits(root, experiments, names):
    """Raise ValueError if a split that an experiment is measured on has no sequence."""
    for split in dict.fromkeys(split for name in experiments for split in splits_of(name)):
        if split != "all" and not set(kitti.SPLITS[split]) & set(names):
            raise ValueError(f"{root}: has none of the sequences of the {split} split, "
                             f"{' '.join(kitti.SPLITS[split])}, on which the table is measured")


def count_scans(root, names):
    """Count the scans of the simulated city in ROOT before it is made.

    Returns {sequence: number of scans}, and a list of those that `names` mean.
    """
    scans = {name: kitti.default_scans(name) for name in sorted(kitti.expand_splits("all"))}
    chosen = kitti.expand_splits(names)
    if unknown := set(chosen) - set(scans):
        raise ValueError(f"{root}: the simulated city has no sequence {' '.join(sorted(unknown))}")
    return scans, chosen


def main():
    """Run the command line."""
    if sys.argv[1:2] == ["--child"]:
        return run_child(**json.loads(sys.argv[2]))
    args = command_line()
    signal.signal(signal.SIGTERM, stop_children)
    root = Path(args.data or d3dlo.SIMULATED)
    complete = all((root / "poses" / f"{name}.txt").exists()
                   for name in kitti.expand_splits("all"))
    if args.dry_run and not args.data and not complete:  # count, but do not simulate
        sequences, (scans, trained) = [], count_scans(root, args.sequences)
    else:
        root = root if args.data else kitti.simulate(root)
        sequences = [s for s in kitti.open_sequences(root) if s.poses is not None]
        scans = {s.name: len(s) for s in sequences}
        trained = [s.name for s in kitti.open_sequences(root, args.sequences)]
    evaluated = list(scans)
    check_splits(root, args.experiments, evaluated)
    if missing := set(trained) - set(scans):
        raise ValueError(f"{root}: sequence {' '.join(sorted(missing))} has no ground truth")
    pairs = sum(scans[name] - 1 for name in trained)

    data = trained, {s.name: fingerprint(s) for s in sequences}
    runs = plan(args.experiments, pairs, args.budget, args.seeds, args.out, data)
    unique = {}
    for run in (run for rows in runs.values() for row in rows.values() for run in row):
        unique.setdefault(run.folder, run)
    todo = [run for run in unique.values() if not run.finished()]
    steps = pair_steps(next(iter(unique.values())).config, pairs)
    print(f"{len(unique)} runs, {len(unique) - len(todo)} of them finished; {pairs:,} pairs of "
          f"{root}, {steps:,} pair-steps a run", flush=True)
    configs = list(dict.fromkeys(run.config for run in unique.values()))
    if args.dry_run:
        return dry_run(todo, steps, sum(scans.values()), configs, args.jobs)
    for run in todo:  # caches first, with all cores
        d3dlo.load_geometry(sequences, widest(run.config, configs))
    run_all(todo, root, trained, evaluated, configs, args.jobs)
    for experiment, rows in runs.items():
        words = caption(experiment, args, trained, pairs, steps)
        if experiment == "table2":
            words += f"\n\n{effects_in_markdown(rows)}"
        write_table(experiment, rows, args.out, words)


if __name__ == "__main__":
    try:
        main()
    except (ValueError, OSError, RuntimeError) as error:
        sys.exit(f"experiments: {error}")
    except KeyboardInterrupt:
        sys.exit("\nexperiments: interrupted; run the same command again to resume")
