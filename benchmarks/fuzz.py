"""Feed damaged and malicious files to every reader.

    python benchmarks/fuzz.py  # 20,000 inputs, some minutes of one core
    python benchmarks/fuzz.py --inputs 500 --seed 7

A valid file is truncated, emptied, overwritten with noise, spliced, given other numbers (NaN,
infinite, huge) or other settings, or replaced by another kind of file, among them pickles that run
code. A reader must return a valid result, or raise ValueError or OSError with a one-line message
that names the file. A cache or weights that it accepts must equal those that were written. All else
is a failure: another exception, an invalid result, more than 20 seconds, or code that was run.
"""
import argparse
import collections
import contextlib
import functools
import io
import json
import math
import os
import pickle
import sys
import tempfile
import time
import zipfile
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
               mpn=Layer(None, None, None, (16, 32)), mlp=Layer(None, None, None, (16, 6)),
               max_range=50.0, plane=True)
RECORD = d3dlo.geometry_dtype(SMALL)
CACHE_ROW = np.dtype([("record", RECORD), ("scan_crc", "u4"), ("crc", "u4")])
WORDS = [b"nan", b"inf", b"-1e308", b"1e400", b"0", b"x", b"", b"\xff\xfe", b"9" * 400, b"\0",
         b"null", b"{}", b"1e-320", b"[", b"NaN"]
FLOATS = [math.nan, math.inf, -math.inf, 3e38, 0, 1e-42]
VALUES = [None, True, -1, 0, 3, 0.5, math.nan, math.inf, 10**30, "", "x", "../x", "\0", [], [1],
          [None], {}, {"x": 1}]
NAME_PARTS = ["..", "/", "\\", "\0", "etc", "00", "~", " ", "\n", "C:", ".", "*", "é", "%00",
              "x" * 300]


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


def truncate(rng, good, others):
    """Keep only the start of the file, or nothing."""
    return good[:rng.integers(len(good))] if rng.random() < 0.5 else b""


def noise(rng, good, others):
    """Replace the file by random bytes."""
    return rng.bytes(int(rng.integers(1, 5000)))


def flip_bits(rng, good, others):
    """Flip up to 20 bits."""
    data = bytearray(good)
    for i in rng.integers(len(data), size=rng.integers(1, 20)):
        data[i] ^= 1 << int(rng.integers(8))
    return bytes(data)


def overwrite(rng, good, others):
    """Overwrite a part with random bytes, or insert them."""
    at, n = rng.integers(len(good) + 1), int(rng.integers(1, 200))
    return good[:at] + rng.bytes(n) + good[at + n * rng.integers(2):]


def replace_word(rng, good, others):
    """Replace a word in a text."""
    words = good.split(b" ")
    words[rng.integers(len(words))] = WORDS[rng.integers(len(WORDS))]
    return b" ".join(words)


def replace_floats(rng, good, others):
    """Replace numbers in a binary file of float32."""
    values = np.frombuffer(good[:len(good) // 4 * 4], "<f4").copy()
    values[rng.integers(len(values), size=rng.integers(1, len(values) + 1))] = rng.choice(FLOATS)
    return values.tobytes()


def repeat(rng, good, others):
    """Repeat the content two or three times."""
    return good * int(rng.integers(2, 4))


def other_file(rng, good, others):
    """Replace the file by one of another kind."""
    return others[rng.integers(len(others))]


def shuffle_lines(rng, good, others):
    """Drop, repeat and reorder lines."""
    lines = good.splitlines(keepends=True)
    return b"".join(lines[i] for i in rng.integers(len(lines), size=rng.integers(len(lines) + 1)))


def replace_setting(rng, good, others):
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


MUTATIONS = [truncate, noise, flip_bits, overwrite, replace_word, replace_floats, repeat,
             other_file, shuffle_lines, replace_setting]


# Readers: each has a valid file, a function that reads it, and a check of the result

def finite(array, *shape):
    """Whether an array has the shape (None: any length) and finite numbers."""
    fits = array.ndim == len(shape) and all(n in (None, m) for n, m in zip(shape, array.shape))
    return fits and array.dtype.kind in "iuf" and bool(np.isfinite(array).all())


def read_record(path):
    """A scan file -> the record that the cache keeps of it."""
    compute = functools.partial(d3dlo.scan_geometry, config=SMALL)
    row = kitti._cache_row((path, 1), compute, CACHE_ROW)
    return np.frombuffer(row, CACHE_ROW)["record"][0]


def read_cache(path):
    """A cache file -> its rows. ValueError with the message of `cached_records` when damaged."""
    with contextlib.redirect_stderr(io.StringIO()) as message:
        intact = kitti._is_intact(path, CACHE_ROW, 3)
    if not intact:
        raise ValueError(message.getvalue().strip())
    return np.load(path)


def valid_run(run):
    """Whether the result of `read_run` has the types that `train` relies on."""
    config, data, sequences, seed, weights = run
    return (isinstance(config, Config)
            and all(path is None or isinstance(path, str) for path in (data, weights))
            and isinstance(sequences, list) and all(isinstance(name, str) for name in sequences)
            and isinstance(seed, int) and seed >= 0)


def make_readers(folder, rng):
    """Write a valid file of each kind -> {reader: (its path, read, check)}."""
    scan = np.c_[rng.uniform(-20, 20, (400, 3)), rng.random(400)].astype(np.float32)
    scan.tofile(folder / "000000.bin")
    poses = d3dlo.accumulate(kitti.from_vector(rng.normal(size=(9, 6))))
    metrics.write_poses(folder / "poses.txt", poses)
    (folder / "calib.txt").write_text(kitti._calibration()[1])
    compute = functools.partial(d3dlo.scan_geometry, config=SMALL)
    row = kitti._cache_row((folder / "000000.bin", 1), compute, CACHE_ROW)
    rows = np.frombuffer(row * 3, CACHE_ROW)
    np.save(folder / "cache.npy", rows)
    arguments = dict(data=None, sequences=["00"], seed=0, device="cpu", weights=None)
    d3dlo.write_run(folder, arguments, SMALL)
    model = d3dlo.D3DLO(SMALL).state_dict()
    d3dlo.save(folder / "weights.pt", model=model, config=SMALL.as_dict(), step=1,
               train={"00": "0" * 16}, before=["1" * 16], mean_motion=[0.0] * 6,
               seen=[[1.0] * len(kitti.STATS)] * 2)

    def valid_weights(result):
        net, state = result
        fingerprints = [*state["train"].values(), *state["before"]]
        return (all(torch.equal(tensor, model[name]) for name, tensor in net.state_dict().items())
                and all(isinstance(fingerprint, str) for fingerprint in fingerprints)
                and finite(np.array(state["seen"]), 2, len(kitti.STATS))
                and finite(np.array(state["mean_motion"]), 6))

    readers = {
        "scan": ("000000.bin", kitti.read_scan, lambda scan: scan.shape[1:] == (4,)),
        "geometry": ("000000.bin", read_record, lambda record: (
            finite(record["xyz"], 32, 3) and finite(record["group_sa1"], 32, 4, 4))),
        "poses": ("poses.txt", metrics.read_poses, lambda T: finite(T, None, 4, 4)),
        "calibration": ("calib.txt", kitti.read_calib, lambda T: finite(T, 4, 4)),
        "weights": ("weights.pt", d3dlo.load_weights, valid_weights),
        "cache": ("cache.npy", read_cache, lambda read: read.tobytes() == rows.tobytes()),
        "run": ("config.json", lambda path: d3dlo.read_run(path.parent), valid_run),
    }
    return {name: (folder / file, *rest) for name, (file, *rest) in readers.items()}


def outcome_of(read, source, check, named):
    """Return "right", "refused", or what went wrong. named: whether a message names the source."""
    began = time.monotonic()
    try:
        result = read(source)
        outcome = "right" if check(result) else "an invalid result"
    except (ValueError, OSError) as error:
        outcome = "refused" if named(str(error)) else f"not one line with its name: {error!r:.300}"
    except Exception as error:
        outcome = f"{error!r:.300}"
    if Path("it-ran").exists():
        Path("it-ran").rmdir()
        return "code of the file ran"
    return outcome if time.monotonic() - began < 20 else "more than 20 s"


def try_file(reader, mutation, rng, others):
    """Read a mutated file. Returns the outcome and the bytes that were read."""
    path, read, check = reader
    good = path.read_bytes()
    data = mutation(rng, good, others)
    path.write_bytes(data)
    outcome = outcome_of(read, path, check, lambda line: path.name in line and "\n" not in line)
    path.write_bytes(good)
    return outcome, data


def try_name(root, rng):
    """Open a sequence by a random, possibly dangerous name. Returns the outcome and the name."""
    name = "".join(rng.choice(NAME_PARTS, rng.integers(1, 6)))
    return outcome_of(lambda name: kitti.open_sequences(root, [name]), name,
                      lambda sequences: [s.name for s in sequences] == ["00"],
                      lambda line: name in line or repr(name)[1:-1] in line), name


def main():
    """Run the command line. Returns the exit code: 1 if there are failures."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, default=20000, metavar="N", help=(
        "number of inputs (default: 20000)"))
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="default: 0")
    args = parser.parse_args()
    torch.set_num_threads(1)
    rng, counts, failures = np.random.default_rng(args.seed), collections.Counter(), 0
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        readers = make_readers(Path(folder), rng)
        for name, (path, read, check) in readers.items():
            assert check(read(path)), name
        others = [path.read_bytes() for path, *_ in readers.values()] + malicious_files()
        kitti.simulate("root", sequences=("00",), scans=1, azimuth=100)
        kinds = [*readers, "sequence name"]
        for i in kitti.progress(range(args.inputs), args.inputs, "inputs"):
            kind = kinds[i % len(kinds)]
            mutation = MUTATIONS[rng.integers(len(MUTATIONS))]
            if kind in readers:
                outcome, data = try_file(readers[kind], mutation, rng, others)
            else:
                outcome, data = try_name("root", rng)
            if outcome not in ("right", "refused"):
                failures += 1
                change = f", {mutation.__name__}" if kind in readers else ""
                print(f"input {i}, {kind}{change}: {outcome}; {len(data)} bytes, {data[:200]!r}",
                      flush=True)
                outcome = "failed"
            counts[kind, outcome] += 1
        os.chdir("/")
    for (kind, outcome), n in sorted(counts.items()):
        print(f"{kind}: {n:,} {outcome}")
    print(f"{args.inputs:,} inputs (seed {args.seed}), {failures} failures")
    return failures > 0


if __name__ == "__main__":
    sys.exit(main())
