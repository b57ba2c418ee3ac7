"""What does every reader do with damaged and malicious files?

    python benchmarks/fuzz.py  # 20,000 inputs, about a minute
    python benchmarks/fuzz.py --inputs 500 --seed 7

A valid file is truncated, overwritten with noise, spliced, given other numbers (NaN, infinite,
huge) or other settings, or replaced by another kind of file, among them pickles that run code. A
reader must return a valid result, or raise ValueError or OSError with a one-line message that names
the file. Weights that it accepts must equal those that were written. A cache file that NumPy cannot
read, or of another dtype or length, must be computed again; other numbers inside it cannot be
noticed. All else is a failure: another exception, an invalid result, more than 20 seconds, or code
that was run.
"""
import argparse
import collections
import contextlib
import io
import json
import math
import os
import pickle
import shutil
import sys
import tempfile
import time
import zipfile
from functools import partial
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import d3dlo
import kitti
import metrics
from d3dlo import Config, Layer

SMALL = Config(sa1=Layer(2.0, 32, 4, (4, 8)), fe=Layer(None, None, 4, (8, 16)),
               sa2=Layer(4.0, 16, 4, (16, 16)), sa3=Layer(8.0, 8, 4, (16, 16)),
               mpn=Layer(None, None, None, (16, 32)), mlp=Layer(None, None, None, (16, 6)))
WORDS = [b"nan", b"inf", b"-1e308", b"1e400", b"0", b"x", b"", b"\xff\xfe", b"9" * 400, b"\0",
         b"null", b"{}", b"1e-320", b"[", b"NaN"]
FLOATS = [math.nan, math.inf, -math.inf, 3e38, 0, 1e-42]
VALUES = [None, True, -1, 0, 3, 0.5, math.nan, math.inf, 10**30, "", "x", "../x", "\0", [], [1],
          [None], {}, {"x": 1}]
NAME_PARTS = ["..", "/", "\\", "\0", "etc", "00", "~", " ", "\n", "C:", ".", "*", "é", "%00",
              "x" * 300]

# ------------------------------------------------------------------------------------------------
# Inputs


class Bomb:
    """Makes a folder when it is unpickled."""

    def __reduce__(self):
        return os.mkdir, ("it-ran",)


def malicious_files():
    """Files that run code when an unsafe reader opens them, and an archive of 200 MB of zeros."""
    torch.save(Bomb(), saved := io.BytesIO())
    np.save(array := io.BytesIO(), np.array([Bomb()], dtype=object), allow_pickle=True)
    with zipfile.ZipFile(zeros := io.BytesIO(), "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("weights/data.pkl", bytes(200_000_000))
    return [pickle.dumps(Bomb()), saved.getvalue(), array.getvalue(), zeros.getvalue()]


def flip_bits(rng, good):
    """Flip up to 20 bits."""
    bits = np.unpackbits(np.frombuffer(good, np.uint8))
    bits[rng.integers(len(bits), size=rng.integers(1, 20))] ^= 1
    return np.packbits(bits).tobytes()


def overwrite(rng, good):
    """Overwrite a part with random bytes, or insert them."""
    at, n = rng.integers(len(good) + 1), int(rng.integers(1, 200))
    return good[:at] + rng.bytes(n) + good[at + n * rng.integers(2):]


def replace_word(rng, good):
    """Replace a word in a text."""
    words = good.split(b" ")
    words[rng.integers(len(words))] = WORDS[rng.integers(len(WORDS))]
    return b" ".join(words)


def replace_floats(rng, good):
    """Replace numbers in a binary file of float32."""
    values = np.frombuffer(good[:len(good) // 4 * 4], "<f4").copy()
    values[rng.integers(len(values), size=rng.integers(1, len(values) + 1))] = rng.choice(FLOATS)
    return values.tobytes()


def shuffle_lines(rng, good):
    """Drop, repeat and reorder lines."""
    lines = good.splitlines(keepends=True)
    return b"".join(lines[i] for i in rng.integers(len(lines), size=rng.integers(len(lines) + 1)))


def replace_setting(rng, good):
    """Replace a value in JSON or in a weights file. Other files are not changed."""
    if good.startswith(b"{"):
        return json.dumps(replace_value(rng, json.loads(good))).encode()
    if good.startswith(b"PK"):
        state = torch.load(io.BytesIO(good), weights_only=True)
        torch.save(replace_value(rng, state), out := io.BytesIO())
        return out.getvalue()
    return good


def replace_value(rng, tree):
    """Replace one value in nested dicts and lists, at a random place and depth."""
    if not isinstance(tree, (dict, list)) or not tree or rng.random() < 0.1:
        return VALUES[rng.integers(len(VALUES))]
    keys = list(tree) if isinstance(tree, dict) else range(len(tree))
    key, tree = keys[rng.integers(len(keys))], tree.copy()
    tree[key] = replace_value(rng, tree[key])
    return tree


CHANGES = [
    lambda rng, good: b"",
    lambda rng, good: good[:rng.integers(len(good))],
    lambda rng, good: rng.bytes(int(rng.integers(1, 5000))),
    lambda rng, good: good * int(rng.integers(2, 4)),
    flip_bits, overwrite, replace_word, replace_floats, shuffle_lines, replace_setting]

# ------------------------------------------------------------------------------------------------
# Readers: each has a valid file, a function that reads it, and a check of the result


def finite(array, *shape):
    """Whether an array ends in this shape and its numbers are finite."""
    return np.shape(array)[-len(shape):] == shape and bool(np.isfinite(array).all())


def write_raw_drive(folder):
    """Write a drive of KITTI's raw data with two scans. Returns its folder."""
    drive = folder / "2011_09_26_drive_0001_sync"
    packet = b"49.0 8.4 112.0 0.03 0.01 1.5 -1.0 8.0 9.0" + b" 0.1" * 21
    for stream, suffix, data in ("velodyne_points", "bin", bytes(160)), ("oxts", "txt", packet):
        (drive / stream / "data").mkdir(parents=True)
        for i in range(2):
            (drive / stream / "data" / f"{i:010d}.{suffix}").write_bytes(data)
        (drive / stream / "timestamps.txt").write_text("2011-09-26 13:02:25.95\n" * 2)
    for name, row in (("cam_to_cam", "R_rect_00"), ("velo_to_cam", "R"), ("imu_to_velo", "R")):
        (folder / f"calib_{name}.txt").write_text(f"{row}: 1 0 0 0 1 0 0 0 1\nT: 0 0 0\n")
    return drive


def read_raw(drive, path):
    """Convert a raw drive, one of whose files is `path` -> the poses of its scans."""
    shutil.rmtree("converted", ignore_errors=True)
    with contextlib.redirect_stderr(io.StringIO()):
        try:
            names = list(kitti.convert_raw(drive, "converted"))
        except (ValueError, OSError):
            assert not Path("converted").exists()
            raise
    return np.concatenate([s.poses for s in kitti.open_sequences("converted", names)])


def read_cache(s, good, path):
    """Load the records of a sequence from a damaged cache -> whether they are as they must be."""
    found = path.read_bytes()
    with contextlib.redirect_stderr(io.StringIO()):
        records, = d3dlo.load_records([s], SMALL)
    again = path.read_bytes() != found
    return ((records.dtype, records.shape) == (good.dtype, good.shape)
            and (not again or records.tobytes() == good.tobytes()))


def valid_weights(model, result):
    """Whether loaded weights equal those of `model`, and the facts beside them are sound."""
    net, state = result
    return (all(torch.equal(tensor, model[name]) for name, tensor in net.state_dict().items())
            and all(isinstance(fingerprint, str) for fingerprint in state["trained_on"])
            and finite(state["seen"], 2, len(kitti.STATS)) and finite(state["mean_motion"], 6))


def make_readers(rng):
    """Write a valid file of each kind -> {reader: (its path, read, check)}."""
    scan = np.c_[rng.uniform(-20, 20, (400, 3)), rng.random(400)].astype(np.float32)
    scan.tofile("scan.bin")
    for path in ("scan.npy", "plain/0.npy", "timed/0.npy"):
        Path(path).parent.mkdir(exist_ok=True)
        np.save(path, scan)
    Path("timed/times.txt").write_text("1.5\n")
    metrics.write_poses("poses.txt", d3dlo.accumulate(kitti.from_vector(rng.normal(size=(9, 6)))))
    Path("calib.txt").write_text("P0: 1 2 3\nTr: 0 -1 0 0 0 0 -1 0 1 0 0 0\n")
    arguments = dict(data=None, sequences=["00"], seed=0, device="cpu", weights=None)
    metrics.write_json("config.json", {"arguments": arguments, "config": SMALL.as_dict()})
    model = d3dlo.D3DLO(SMALL).state_dict()
    d3dlo.save("weights.pt", model=model, config=SMALL.as_dict(), step=1, trained_on=["0" * 16],
               mean_motion=[0.0] * 6, seen=[[1.0] * len(kitti.STATS)] * 2)
    s, drive = kitti.Sequence("plain"), write_raw_drive(Path("raw"))
    good = np.array(d3dlo.load_records([s], SMALL)[0])
    cache, = Path("cache").iterdir()
    return {
        "scan.bin": ("scan.bin", kitti.read_scan, lambda scan: scan.shape[1:] == (4,)),
        "scan.npy": ("scan.npy", kitti.read_scan, lambda scan: scan.shape[1:] == (4,)),
        "record": ("scan.bin", lambda path: d3dlo.record_of_file((path, 1), SMALL),
                   lambda record: finite(record["group_sa1"], 32, 4, 4)),
        "cache": (cache, partial(read_cache, s, good), bool),
        "times": ("timed/times.txt", lambda path: kitti.Sequence(path.parent).times,
                  lambda times: finite(times, 1)),
        "poses": ("poses.txt", metrics.read_poses, lambda T: finite(T, 4, 4)),
        "calibration": ("calib.txt", kitti.read_calib, lambda T: finite(T, 4, 4)),
        "weights": ("weights.pt", d3dlo.load_weights, partial(valid_weights, model)),
        "run": ("config.json", lambda path: d3dlo.read_run(path.parent),
                lambda run: [type(run[i]) for i in (0, 2, 3)] == [Config, list, int]),
        **{f"raw {path.name}": (path, partial(read_raw, drive), lambda T: finite(T, 4, 4))
           for path in (drive / "oxts/timestamps.txt", drive / "oxts/data/0000000001.txt",
                        drive.parent / "calib_velo_to_cam.txt")}}


# ------------------------------------------------------------------------------------------------
# Trying


def outcome_of(read, source, check, named):
    """Return "right", "refused", or what went wrong. named: whether a message names the source."""
    began = time.monotonic()
    try:
        outcome = "right" if check(read(source)) else "an invalid result"
    except (ValueError, OSError) as error:
        outcome = "refused" if named(str(error)) else f"not one line with its name: {error!r:.200}"
    except Exception as error:
        outcome = f"{error!r:.200}"
    if Path("it-ran").exists():
        Path("it-ran").rmdir()
        return "code of the file ran"
    return outcome if time.monotonic() - began < 20 else "more than 20 s"


def try_file(path, read, check, rng, changes):
    """Read a file after a random change. Returns the outcome and the bytes that were read."""
    path = Path(path)
    good = path.read_bytes()
    data = changes[rng.integers(len(changes))](rng, good)
    path.write_bytes(data)
    outcome = outcome_of(read, path, check, lambda line: "\n" not in line and (
        path.name in line or "drive_0001" in line))  # some messages concern the whole raw drive
    path.write_bytes(good)
    return outcome, data


def try_name(rng):
    """Open a sequence by a random, possibly dangerous name. Returns the outcome and the name."""
    name = "".join(rng.choice(NAME_PARTS, rng.integers(1, 6)))
    return outcome_of(lambda name: kitti.open_sequences("root", [name]), name,
                      lambda sequences: [s.name for s in sequences] == ["00"],
                      lambda line: name in line or repr(name)[1:-1] in line), name


def try_all(inputs, seed):
    """Try a number of inputs. Prints failures and a summary. Returns the number of failures."""
    rng, counts = np.random.default_rng(seed), collections.Counter()
    readers = make_readers(rng)
    for name, (path, read, check) in readers.items():
        assert check(read(Path(path))), name
    others = [Path(path).read_bytes() for path, *_ in readers.values()] + malicious_files()
    np.save(longer := io.BytesIO(), np.repeat(np.load(readers["cache"][0]), 2))
    others.append(longer.getvalue())
    changes = [*CHANGES, lambda rng, good: others[rng.integers(len(others))]]
    kitti.simulate("root", sequences=["00"], scans=1, azimuth=100)
    kinds = [*readers, "sequence name"]
    for i in kitti.progress(range(inputs), inputs, "inputs"):
        kind = kinds[i % len(kinds)]
        outcome, data = (try_file(*readers[kind], rng, changes) if kind in readers
                         else try_name(rng))
        if outcome not in ("right", "refused"):
            print(f"input {i}, {kind}: {outcome}; {len(data)} bytes, {data[:100]!r}", flush=True)
            outcome = "failed"
        counts[kind, outcome] += 1
    for (kind, outcome), n in sorted(counts.items()):
        print(f"{kind}: {n:,} {outcome}")
    failures = sum(n for (_, outcome), n in counts.items() if outcome == "failed")
    print(f"{inputs:,} inputs (seed {seed}), {failures} failures")
    return failures


def main():
    """Run the command line. Returns the exit code: 1 if there are failures."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, default=20000, metavar="N", help=(
        "number of inputs (default: 20000)"))
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="default: 0")
    args = parser.parse_args()
    torch.set_num_threads(1)
    # A worker process for every damaged cache would take most of the time
    kitti.in_processes = lambda compute, tasks: (compute(task) for task in tasks)
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        failures = try_all(args.inputs, args.seed)
        os.chdir("/")
    return failures > 0


if __name__ == "__main__":
    sys.exit(main())
