"""Hostile and broken files for every reader: each must be read right or refused in one line that names it.

    python benchmarks/fuzz.py                       # 20,000 inputs, some minutes of one core
    python benchmarks/fuzz.py --inputs 500 --seed 7

A valid file is cut, emptied, filled with noise, spliced, given other numbers (NaN, infinite, huge) or another kind of content, a pickle that
runs code among them, and read. What is returned must have the right shape and hold finite numbers; a cache, and weights, those that were
written. Counted as failures: any other exception, a line that does not name the file, more than 20 seconds, code that ran.
"""
import argparse
import collections
import contextlib
import io
import json
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

SMALL = Config(sa1=Layer(2.0, 32, 4, (4, 8)), fe=Layer(None, None, 4, (8, 16)), sa2=Layer(4.0, 16, 4, (16, 16)), sa3=Layer(8.0, 8, 4, (16, 16)),
               mpn=Layer(None, None, None, (16, 32)), mlp=Layer(None, None, None, (16, 6)))
TOKENS = [b"nan", b"inf", b"-1e308", b"1e400", b"0", b"x", b"", b"\xff\xfe", b"9" * 400, b"\0", b"null", b"{}", b"1e-320", b"[", b"NaN"]


class Bomb:
    """Leaves a file behind when it is unpickled."""
    def __reduce__(self):
        return os.mkdir, ("it-ran",)


def bombs():
    """Files that run code when they are read without care."""
    torch.save(Bomb(), buffer := io.BytesIO())
    np.save(array := io.BytesIO(), np.array([Bomb()], dtype=object), allow_pickle=True)
    return pickle.dumps(Bomb()), buffer.getvalue(), array.getvalue()


def mutate(rng, good, others):
    """Bytes -> other bytes."""
    data, kind = bytearray(good), rng.integers(11)
    at = int(rng.integers(len(data) + 1))
    if kind == 0:
        return bytes(data[:at])
    if kind == 1:
        return b""
    if kind == 2:
        return rng.bytes(int(rng.integers(1, 5000)))
    if kind == 3:                                       # flipped bits
        for i in rng.integers(len(data), size=int(rng.integers(1, 20))):
            data[i] ^= 1 << int(rng.integers(8))
    elif kind == 4:                                     # noise over a stretch
        n = int(rng.integers(1, 200))
        data[at:at + n] = rng.bytes(n)
    elif kind == 5:
        data[at:at] = rng.bytes(int(rng.integers(1, 50)))
    elif kind == 6:                                     # a number for another, in text or in binary
        words = bytes(data).split(b" ")
        words[int(rng.integers(len(words)))] = TOKENS[int(rng.integers(len(TOKENS)))]
        return b" ".join(words)
    elif kind == 7 and len(data) >= 8:
        values = np.frombuffer(bytes(data[:len(data) // 4 * 4]), "<f4").copy()
        values[rng.integers(len(values), size=int(rng.integers(1, len(values) + 1)))] = rng.choice([np.nan, np.inf, -np.inf, 3e38, 0, 1e-42])
        return values.tobytes()
    elif kind == 8:
        return bytes(data) * int(rng.integers(2, 4))
    elif kind == 9:
        return others[int(rng.integers(len(others)))]
    else:                                               # lines lost, doubled, in disorder
        lines = bytes(data).splitlines(keepends=True)
        return b"".join(lines[i] for i in rng.integers(len(lines), size=int(rng.integers(len(lines) + 1))))
    return bytes(data)


def finite(array, *shape):
    """Whether an array has the shape (None: any) and finite numbers."""
    return array.ndim == len(shape) and all(n in (None, m) for n, m in zip(shape, array.shape)) and bool(np.isfinite(array).all())


def readers(folder, rng):
    """Name -> (a valid file's bytes, its path, what reads it, what must hold for the answer)."""
    scan = np.c_[rng.uniform(-20, 20, (400, 3)), rng.random(400)].astype(np.float32)
    poses = d3dlo.accumulate(kitti.from_vector(rng.normal(size=(9, 6))))
    metrics.write_poses(folder / "poses.txt", poses)
    net = d3dlo.D3DLO(SMALL)
    weights = dict(config=SMALL.as_dict(), model=net.state_dict(), step=1, train={"00": "0" * 16}, mean_motion=[0.0] * 6,
                   before=[], seen=[[1.0] * len(d3dlo.LOOKS)] * 2)
    d3dlo.save(folder / "weights.pt", **weights)
    records = np.stack([d3dlo.scan_geometry(scan, SMALL)] * 3)
    np.save(folder / "cache.npy", records)
    (folder / "config.json").write_text(json.dumps(dict(arguments=dict(data=None, sequences=["00"], seed=0, weights=None), config=SMALL.as_dict())))
    (folder / "calib.txt").write_text(kitti._calibration()[1])
    scan.tofile(folder / "000000.bin")

    def cached(path):                                   # damage is no error: the cache is made again
        with contextlib.redirect_stderr(io.StringIO()):
            return d3dlo._cached(path, records.dtype, len(records))

    def same_weights(answer):
        return all(torch.equal(a, b) for a, b in zip(answer[0].state_dict().values(), weights["model"].values()))
    read = {
        "scan": ("000000.bin", kitti.read_scan, lambda a: a.ndim == 2 and a.shape[1] == 4),
        "geometry of a scan": ("000000.bin", lambda path: d3dlo._geometry_of_file(path, SMALL), lambda r: finite(r["xyz"], 32, 3) and finite(r["group"], 32, 4, 4)),
        "poses": ("poses.txt", metrics.read_poses, lambda T: finite(T, None, 4, 4)),
        "calibration": ("calib.txt", kitti.read_calib, lambda T: finite(T, 4, 4)),
        "weights": ("weights.pt", d3dlo.load_weights, same_weights),
        "cache": ("cache.npy", cached, lambda r: r is None or r.tobytes() == records.tobytes()),
        "settings of a run": ("config.json", lambda path: d3dlo.begun_with(path.parent), lambda begun: isinstance(begun[0], Config)),
    }
    return {name: ((folder / file).read_bytes(), folder / file, *how) for name, (file, *how) in read.items()}


def attempt(read, path, holds):
    """"right", "refused", or what went wrong."""
    began = time.monotonic()
    try:
        answer = read(path)
        outcome = "right" if holds(answer) else f"a wrong answer: {str(answer)[:200]}"
    except (ValueError, OSError) as error:
        outcome = "refused" if path.name in str(error) and "\n" not in str(error) else f"no line that names the file: {error!r}"
    except Exception as error:
        outcome = repr(error)
    if Path("it-ran").exists():
        return "code of the file ran"
    return outcome if time.monotonic() - began < 20 else "more than 20 s"


def names(rng):
    """Sequence names that lead elsewhere, or nowhere."""
    parts = ["..", "/", "\\", "\0", "etc", "00", "~", " ", "\n", "C:", ".", "*", "é", "%00", "x" * 300]
    return "".join(rng.choice(parts, int(rng.integers(1, 6))))


def main():
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, default=20000, metavar="N")
    parser.add_argument("--seed", type=int, default=0, metavar="N")
    args = parser.parse_args()
    torch.set_num_threads(1)
    rng, counts, failures = np.random.default_rng(args.seed), collections.Counter(), 0
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        kinds = readers(Path(folder), rng)
        for name, (good, path, read, holds) in kinds.items():
            assert attempt(read, path, holds) == "right", name
        others = [good for good, *_ in kinds.values()] + [*bombs(), zip_bomb()]
        kitti.simulate("root", sequences=("00",), scans=1, azimuth=100)
        for i in kitti.progress(range(args.inputs), args.inputs, "inputs"):
            kind = list(kinds)[i % (len(kinds) + 1)] if i % (len(kinds) + 1) < len(kinds) else "sequence name"
            if kind == "sequence name":
                bad = names(rng)
                try:
                    outcome = "right" if [s.name for s in kitti.open_sequences("root", [bad])] == ["00"] else "wrong"
                except (ValueError, OSError) as error:
                    outcome = "refused" if repr(bad)[1:-1] in str(error) or bad in str(error) else f"a line without the name: {error}"
            else:
                good, path, read, holds = kinds[kind]
                path.write_bytes(data := mutate(rng, good, others))
                outcome = attempt(read, path, holds)
                path.write_bytes(good)
            if outcome not in ("right", "refused"):
                failures += 1
                print(f"input {i}, {kind}: {outcome}" + ("" if kind == "sequence name" else f"; {len(data)} bytes, {data[:60]!r}"), flush=True)
            counts[kind, outcome if outcome in ("right", "refused") else "failed"] += 1
        os.chdir("/")
    for (kind, outcome), n in sorted(counts.items()):
        print(f"{kind}: {n:,} {outcome}")
    print(f"{args.inputs:,} inputs (seed {args.seed}), {failures} failures")
    return failures > 0


def zip_bomb():
    """A small archive of 200 MB of zeros under the name torch looks for."""
    with zipfile.ZipFile(buffer := io.BytesIO(), "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("weights/data.pkl", bytes(200_000_000))
    return buffer.getvalue()


if __name__ == "__main__":
    sys.exit(main())
