"""Which of the paper's choices matter? Runs its experiments, prints our figures beside its own.

    python benchmarks/experiments.py table2 --dry-run      # list the runs
    python benchmarks/experiments.py loss coordinates      # simulated city, 10,000 pair-steps a run
    python benchmarks/experiments.py table2 table3 --data ROOT --budget 8000000 --seeds 0 1 2
    python benchmarks/experiments.py ablation --real ROOT  # our additions, scored on real clips too

The first half holds what the paper tried and rejected, as losses and as subclasses of D3DLO. They
are passed to `d3dlo.train` as its `objective` and its `network`.

A pair-step is one pair of scans in one training step. All runs of a table have the same number of
pair-steps, in all and in a batch, the same data and, for the same seed, the same order of pairs.
The recipe is the short one, d3dlo.SHORT.

Every run has a folder in OUT, named by a hash of everything it depends on. Finished runs are not
repeated, interrupted ones are resumed, and tables share runs. The runs follow each other; to use
many cores, give each seed to a process of its own. Each n_n has a cache of its own, which costs
disk space and some minutes: --dry-run prints how much.
"""
import argparse
import hashlib
import json
import math
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import d3dlo  # before torch, whose idle threads then sleep

# isort: split
import numpy as np
import torch
import torch.nn.functional as F
from scipy import stats
from scipy.spatial.transform import Rotation
from torch import nn

import kitti
import metrics
from d3dlo import D3DLO, SHORT, Config, FlowEmbedding, MiniPointNet

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
    """A row of a table, or one row for each split it is measured on."""

    paper: str | dict | tuple = ""  # the paper's words, {split: its E_t [%] and E_r [deg/m]},
    # or only the splits
    changes: dict = {}  # what differs from Config(**SHORT)
    network: type = D3DLO
    objective: Callable[[], nn.Module] = nn.L1Loss
    aligned: float = d3dlo.ALIGNED  # share of pairs that imitate refinement, with augmentation

    def splits(self):
        """{split: the paper's two cells} of the splits it is measured on."""
        if isinstance(self.paper, dict):
            return {split: (f"{E_t}", f"{E_r:.5f}") for split, (E_t, E_r) in self.paper.items()}
        if isinstance(self.paper, tuple):
            return dict.fromkeys(self.paper, ("", ""))
        return {"test": (self.paper, "")}


T1 = Config()
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


def row_of_table_2(n_n, plane, paper):
    """The name and the Variant of a combination of n_n and plane."""
    name = f"n_n = {n_n}, {'with' if plane else 'without'} plane"
    return name, Variant(paper, dict(sa1=T1.sa1._replace(n_n=n_n), plane=plane))


def without(aligned=d3dlo.ALIGNED, **changes):
    """A row of the ablation: our recipe with changes, scored plain and refined."""
    splits = "test", "test, refined", "real", "real, refined"
    return Variant(splits, changes, aligned=aligned)


EXPERIMENTS = {
    "table2": dict(row_of_table_2(*key, {"all": paper}) for key, paper in PAPER_2.items()),
    "table3": dict(row_of_table_2(*key, {"test": test, "validation": validation})
                   for key, (test, validation) in PAPER_3.items()),
    "loss": {
        "eq. 2": Variant("best"),
        "eq. 2 + eq. 5": Variant("no gain", objective=lambda: CosineLoss(1.0)),
        "eq. 2 + 0.1 eq. 5": Variant("no gain", objective=lambda: CosineLoss(0.1)),
        "eq. 2 + eq. 5 of the translation":
            Variant("no gain", objective=lambda: CosineLoss(1.0, n=3)),
        "uncertainty weighting": Variant("no gain", objective=UncertaintyLoss)},
    "output": {
        "Euler angles": Variant("best"),
        "quaternion":
            Variant("no gain", {}, Quaternion, lambda: QuaternionLoss(nn.L1Loss())),
        "quaternion, uncertainty weighting":
            Variant("", {}, Quaternion, lambda: QuaternionLoss(UncertaintyLoss()))},
    "scales": {
        "one scale": Variant("best"),
        "two scales in SA1: 1 m and 2 m": Variant("no gain", TWO_SCALES, TwoScales)},
    "coordinates": {
        "Table 1": Variant(),
        "coordinates into the mini-PointNet": Variant("DeepCLR's", network=Coordinates)},
    "ablation": {
        "our recipe": without(),
        "Adam": without(optimizer="adam"),
        "decays instead of one cycle": without(schedule="steps"),
        "no augmentation": without(augment=False),
        "no aligned pairs": without(aligned=0.0),
        "no fixed statistics": without(frozen=0.0),
        "all points": without(max_range=None),
        "the paper's recipe": without(max_range=None, optimizer="adam", lr=T1.lr, schedule="steps",
                                      augment=False, frozen=0.0),
        "Adam, rate up to 0.003": without(optimizer="adam", lr=3e-3)},
}

# ------------------------------------------------------------------------------------------------
# Runs


class Run(NamedTuple):
    """One training run and its evaluation on all sequences."""

    experiment: str
    variant: str  # EXPERIMENTS[experiment][variant]
    config: Config
    seed: int
    folder: Path

    def results(self, name):
        """The content of results.json of an evaluation, or {} if it is not finished."""
        path = self.folder / name / "results.json"
        content = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
        return content if "pooled" in content else {}


def config_of(changes, pairs, budget):
    """The short recipe with changes. The budget determines the number of epochs, at least one."""
    return Config(**SHORT | changes | {"epochs": max(1, round(budget / pairs))})


def identity(s):
    """A hash of a sequence's calibration and poses, and of the number of points of every scan."""
    sizes = [path.stat().st_size for path in s.scan_paths]
    return hashlib.sha256(repr((s.Tr.tolist(), s.poses.tolist(), sizes)).encode()).hexdigest()


def plan(experiments, pairs, budget, seeds, out, data):
    """{experiment: {variant: [a Run for each seed]}}. data: identifies the data; fit for JSON."""
    def run(experiment, name, seed):
        variant = EXPERIMENTS[experiment][name]
        config = config_of(variant.changes, pairs, budget)
        depends = (config.as_dict(), variant.network.__name__, repr(variant.objective()), seed,
                   variant.aligned, d3dlo.__version__, data)
        key = hashlib.sha256(json.dumps(depends, sort_keys=True).encode()).hexdigest()[:12]
        return Run(experiment, name, config, seed, out / key)

    return {experiment: {name: [run(experiment, name, seed) for seed in seeds]
                         for name in EXPERIMENTS[experiment]} for experiment in experiments}


def evaluations(run, root, sequences, real):
    """{folder: (data, sequences, refinement passes)} of the evaluations of a Run.

    The rows of the ablation are scored on the test split and on the real scans in the folder
    `real`, plain and refined.
    """
    if run.experiment != "ablation":
        return {"all": (root, sequences, 0)}
    every = {"all": (root, sequences, 0), "all-refined": (root, ["test"], 3)}
    if real:
        every |= {"real": (real, ["all"], 0), "real-refined": (real, ["all"], 3)}
    return every


def execute(run, root, trained, every, device):
    """Start or resume a training run, then make those of its evaluations that are missing."""
    variant = EXPERIMENTS[run.experiment][run.variant]
    if not run.results("all"):
        d3dlo.ALIGNED = variant.aligned
        d3dlo.train(run.config, root, trained, run.folder, run.seed, network=variant.network,
                    objective=variant.objective(), device=device,
                    resume=(run.folder / "config.json").exists())
    for name, (data, sequences, refine) in every.items():
        if not run.results(name):
            shutil.rmtree(run.folder / name, ignore_errors=True)  # of an interrupted evaluation
            d3dlo.evaluate(data, run.folder, sequences, run.folder / name, device, refine,
                           network=variant.network, say=lambda text: None)


# ------------------------------------------------------------------------------------------------
# Tables

DIGITS = {key: metrics.COLUMNS[key][1] for key in ("E_t", "E_r", "t_step_m", "r_step_deg")}
HEADER = ["", "split", "paper's E_t [%]", "paper's E_r [deg/m]",
          *(metrics.COLUMNS[key][0] for key in DIGITS)]


def figures(run, split):
    """E_t, E_r, t step and r step of a Run on a split, a dict. NaN without a segment or split."""
    name, _, refined = split.partition(", ")  # "test, refined"
    results = run.results(("real" if name == "real" else "all") + "-refined" * bool(refined))
    pooled = results.get("pooled", {})
    result = pooled if name in ("all", "real") else results.get("splits", {}).get(name, {})
    return {key: math.nan if result.get(key) is None else result[key] for key in DIGITS}


def cell(values, digits):
    """Format the mean over the seeds and, if there are several, their range."""
    if np.isnan(values).any():
        return "-"
    mean, low, high = (f"{x:.{digits}f}" for x in (np.mean(values), min(values), max(values)))
    return mean if len(values) == 1 else f"{mean} ({low} to {high})"


def markdown(lines):
    """Lists of cells, the header first -> a table in Markdown."""
    lines = [lines[0], ["---"] * len(lines[0]), *lines[1:]]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def deviations(measured):
    """Rows of a table: the standard deviation of a seed for each figure, pooled over all variants.

    measured: see `table_of`. With one seed there are no rows.
    """
    rows = []
    for split in next(iter(measured.values())):
        # (variants,figures,seeds)
        values = np.array([[*of_splits[split].values()] for of_splits in measured.values()])
        if values.shape[2] > 1:
            pooled = np.sqrt(values.var(2, ddof=1).mean(0))
            cells = [cell([x], digits) for x, digits in zip(pooled, DIGITS.values())]
            rows.append(["standard deviation of a seed", split, "", "", *cells])
    return rows


def table_of(experiment, rows):
    """The table of an experiment in Markdown, and {variant: {split: {figure: [of each seed]}}}."""
    lines, measured = [HEADER], {}
    for name, runs in rows.items():
        variant, measured[name] = EXPERIMENTS[experiment][name], {}
        for split, paper in variant.splits().items():
            each = [figures(run, split) for run in runs]
            values = measured[name][split] = {key: [f[key] for f in each] for key in DIGITS}
            cells = [cell(values[key], digits) for key, digits in DIGITS.items()]
            lines.append([name, split, *paper, *cells])
    if experiment == "ablation":
        lines += deviations(measured)
    return markdown(lines), measured


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
    lines = [["effect, with its 95 % confidence interval", "split", *HEADER[-4:]]]
    for split in ("test", "all"):
        for name, *row in zip(("the plane", "twice the neighbours"), *effects(rows, split)):
            cells = ["-" if np.isnan(value) else f"{value:+.{digits}f} ± {half_width:.{digits}f}"
                     for value, half_width, digits in zip(*row, DIGITS.values())]
            lines.append([name, split, *cells])
    return markdown(lines)


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
    add("--budget", type=int, default=10000, metavar="N",
        help="pair-steps of a training run (default: 10,000; the paper's have some 8,000,000)")
    add("--seeds", nargs="+", type=int, default=[0, 1], metavar="N", help="default: 0 1")
    add("--out", type=Path, default=Path("runs/experiments"), metavar="OUT",
        help="folder of the runs and of NAME.json, the figures (default: runs/experiments)")
    add("--device", default="cpu", help="cpu, cuda or mps (default: cpu)")
    add("--real", metavar="ROOT", help="real scans, to score the ablation on")
    add("--dry-run", action="store_true", help="list the runs and the size of their caches")
    return parser.parse_args()


def main():
    """Run the command line."""
    args = command_line()
    kitti.keep_freed_memory()
    kitti.treat_sigterm_as_interrupt()
    root = d3dlo.data_root(args.data, ["all"])
    sequences = [s for s in kitti.open_sequences(root) if s.poses is not None]
    chosen = kitti.open_sequences(root, "train")
    trained, pairs = [s.name for s in chosen], sum(len(s.motions()) for s in chosen)
    for experiment in args.experiments:
        for split in next(iter(EXPERIMENTS[experiment].values())).splits():
            if "real" not in split:  # ValueError if ROOT has none of its sequences
                kitti.open_sequences(root, split.split(", ")[0])

    names = [s.name for s in sequences]
    data = trained, {s.name: identity(s) for s in sequences}
    planned = plan(args.experiments, pairs, args.budget, args.seeds, args.out, data)
    runs, wanted = {}, {}  # by folder; experiments share runs, but not all evaluations
    for run in [run for rows in planned.values() for row in rows.values() for run in row]:
        runs[run.folder] = run
        wanted.setdefault(run.folder, {}).update(evaluations(run, root, names, args.real))
    todo = [run for folder, run in runs.items() if not all(map(run.results, wanted[folder]))]
    steps = pairs * config_of({}, pairs, args.budget).epochs
    facts = (f"{root}: trained on {' '.join(trained)} ({pairs:,} pairs), {steps:,} pair-steps a "
             f"run, seeds {' '.join(map(str, args.seeds))}")
    print(f"{facts}; {len(runs)} runs, {len(runs) - len(todo)} of them finished", flush=True)
    for run in todo:
        print(f"{run.experiment}: {run.variant}, seed {run.seed} -> {run.folder}", flush=True)
        if not args.dry_run:
            execute(run, root, trained, wanted[run.folder], args.device)
    if args.dry_run:
        caches = {(run.config.sa1, run.config.plane, run.config.max_range): run.config
                  for run in todo}.values()
        size = sum(map(len, sequences)) * sum(d3dlo.record_dtype(c).itemsize for c in caches)
        return print(f"size of the caches: {size / 1e9:.1f} GB")

    for experiment, rows in planned.items():
        table, measured = table_of(experiment, rows)
        metrics.write_json(args.out / f"{experiment}.json", measured)
        print(f"\n# {experiment}\n\n{table}\n\n{facts}; mean over the seeds (their range).")
        if experiment == "table2":
            print(f"\n{effects_in_markdown(rows)}")


if __name__ == "__main__":
    try:
        main()
    except (ValueError, OSError) as error:
        sys.exit(f"experiments: {error}")
    except KeyboardInterrupt:
        sys.exit("\nexperiments: interrupted; run the same command again to resume")
