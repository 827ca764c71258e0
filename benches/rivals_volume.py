#!/usr/bin/env python3
"""Whole volumes from Zarr to Zarr by TensorStore beside occlude: a pyramid of means, and mean and variance of boxes.

    pip install numpy numba tensorstore
    cargo build --release && python benches/rivals_volume.py target/release/occlude FOLDER [EDGE]

FOLDER takes the input (EDGE^3 u8, 1024 by default, 1 GiB), made once, and every output. Both sides use two threads and
chunks of 64^3; rows say which codec. TensorStore makes each level from the one before by its downsample driver; the box
statistics read slabs with it, sum them by numba, and write slabs. Results are compared before anything is timed. Times
are the best of two; files are in the page cache on both sides.
"""

import json
import pathlib
import shutil
import subprocess
import sys
import time

import numba
import numpy as np
import tensorstore as ts

OCCLUDE, FOLDER = sys.argv[1], pathlib.Path(sys.argv[2])
EDGE = int(sys.argv[3]) if len(sys.argv) > 3 else 1024
RADIUS = 5
CONTEXT = ts.Context({"data_copy_concurrency": {"limit": 2}, "file_io_concurrency": {"limit": 2}})
numba.set_num_threads(2)


def volume():
    """Tissue in air with a little noise, slab by slab."""
    path = FOLDER / "in.raw"
    if not path.exists() or path.stat().st_size != EDGE**3:
        rng = np.random.default_rng(1)
        y, x = np.meshgrid(*[np.linspace(-0.5, 0.5, EDGE, dtype="f4")] * 2, indexing="ij")
        with open(path, "wb") as f:
            for z in np.linspace(-0.5, 0.5, EDGE, dtype="f4"):
                r = np.sqrt(z * z + y * y + x * x)
                v = 100 + 60 * np.sin(40 * z) * np.cos(30 * x) + rng.integers(0, 8, r.shape)
                f.write(np.where(r > 0.45, 0, v).astype("u1").tobytes())
    return path


def occlude(text, sets=()):
    config, report = FOLDER / "job.toml", FOLDER / "report.json"
    config.write_text(text)
    args = [a for s in sets for a in ("--set", s)]
    subprocess.run([OCCLUDE, "run", config, "--overwrite", "-q", "--threads", "2", "--report", report, *args], check=True)
    report = json.loads(report.read_text())
    return report["seconds"], report["peak_memory_bytes"] / 2**20


def best(run):
    return min(run() for _ in range(2))


def open_zarr(path, create=None):
    """An unsharded Zarr v3 array of 64^3 chunks, zstd level 1, or an existing one."""
    spec = {"driver": "zarr3", "kvstore": {"driver": "file", "path": str(path)}}
    if create is None:
        return ts.open(spec, context=CONTEXT).result()
    shape, dtype = create
    spec["metadata"] = {
        "shape": shape,
        "data_type": dtype,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [64] * 3}},
        "codecs": [
            {"name": "bytes", "configuration": {"endian": "little"}},
            {"name": "zstd", "configuration": {"level": 1}},
        ],
    }
    return ts.open(spec, create=True, delete_existing=True, context=CONTEXT).result()


def slabs(n, step=64):
    return [slice(z, min(z + step, n)) for z in range(0, n, step)]


def tensorstore_pyramid(source):
    start, k = time.time(), 0
    fine = open_zarr(source)
    copy = open_zarr(FOLDER / "ts.zarr" / "0", (list(fine.shape), "uint8"))
    for s in slabs(EDGE):
        copy[s].write(fine[s]).result()
    fine = copy
    while max(fine.shape) > 64:
        k += 1
        half = ts.downsample(fine, [2, 2, 2], method="mean")
        coarse = open_zarr(FOLDER / "ts.zarr" / str(k), (list(half.shape), "uint8"))
        for s in slabs(half.shape[0]):
            coarse[s].write(half[s]).result()
        fine = coarse
    return time.time() - start


@numba.njit(parallel=True, fastmath=True, cache=True)
def box_moments(v, first, count, mean, variance):
    """Running sums of x, then y, then z; v holds the slab and its halo, clipped to the volume."""
    nz, ny, nx = v.shape
    s1, s2 = np.empty((nz, ny, nx), np.int32), np.empty((nz, ny, nx), np.int64)
    for z in numba.prange(nz):
        a1, a2 = np.zeros((ny, nx), np.int32), np.zeros((ny, nx), np.int32)
        for y in range(ny):
            t1 = t2 = 0
            for x in range(min(RADIUS, nx)):
                t1 += v[z, y, x]
                t2 += np.int32(v[z, y, x]) ** 2
            for x in range(nx):
                if x + RADIUS < nx:
                    t1 += v[z, y, x + RADIUS]
                    t2 += np.int32(v[z, y, x + RADIUS]) ** 2
                if x > RADIUS:
                    t1 -= v[z, y, x - RADIUS - 1]
                    t2 -= np.int32(v[z, y, x - RADIUS - 1]) ** 2
                a1[y, x], a2[y, x] = t1, t2
        r1, r2 = np.zeros(nx, np.int32), np.zeros(nx, np.int32)
        for y in range(min(RADIUS, ny)):
            r1 += a1[y]
            r2 += a2[y]
        for y in range(ny):
            if y + RADIUS < ny:
                r1 += a1[y + RADIUS]
                r2 += a2[y + RADIUS]
            if y > RADIUS:
                r1 -= a1[y - RADIUS - 1]
                r2 -= a2[y - RADIUS - 1]
            s1[z, y], s2[z, y] = r1, r2
    for y in numba.prange(ny):
        for k in range(count):
            lo, hi = max(first + k - RADIUS, 0), min(first + k + RADIUS + 1, nz)
            for x in range(nx):
                t1 = t2 = 0
                for z in range(lo, hi):
                    t1 += s1[z, y, x]
                    t2 += s2[z, y, x]
                cy = min(y + RADIUS, ny - 1) - max(y - RADIUS, 0) + 1
                cx = min(x + RADIUS, nx - 1) - max(x - RADIUS, 0) + 1
                n = (hi - lo) * cy * cx
                mean[k, y, x] = t1 / n
                variance[k, y, x] = (n * t2 - t1 * t1) / (n * n)


def tensorstore_box(source):
    start = time.time()
    fine = open_zarr(source)
    outs = [open_zarr(FOLDER / f"ts_{name}.zarr", (list(fine.shape), "uint8")) for name in ("mean", "variance")]
    for s in slabs(EDGE):
        lo, hi = max(s.start - RADIUS, 0), min(s.stop + RADIUS, EDGE)
        v, count = fine[lo:hi].read().result(), s.stop - s.start
        mean, variance = (np.empty((count, EDGE, EDGE), np.float32) for _ in range(2))
        box_moments(v, s.start - lo, count, mean, variance)
        pending = [outs[0][s].write(np.rint(mean).astype("u1"))]
        pending.append(outs[1][s].write(np.rint(np.minimum(variance, 2550) / 10).astype("u1")))
        for p in pending:
            p.result()
    return time.time() - start


def check(name, ours, theirs, most):
    a, b = (open_zarr(p)[EDGE // 4 : EDGE // 4 + 32].read().result() for p in (ours, theirs))
    worst = np.abs(a.astype(int) - b.astype(int)).max()
    if worst > most:
        sys.exit(f"{name}: results differ by {worst}")


def row(what, by, codec, seconds, ours=None, note=""):
    print(f"| {what} | {by} | {codec} | {seconds:.2f} | {seconds / ours:.2f} | {note} |" if ours else
          f"| {what} | {by} | {codec} | {seconds:.2f} | 1 | {note} |", flush=True)


def main():
    raw = f'[input.v]\npath = "{volume()}"\nformat = "raw"\nshape = [{EDGE}, {EDGE}, {EDGE}]\ndtype = "u8"\n'
    zstd = 'chunk = 64\nshard = "none"\ncodec = "zstd:1"\n'
    occlude(raw + '[output.o]\npath = "in_zstd.zarr"\nfrom = "v"\nlevels = 1\n' + zstd)
    occlude(raw + '[output.o]\npath = "in.zarr"\nfrom = "v"\nlevels = 1\n')
    print(f"{EDGE}^3 u8, two threads\n\n| work | by | codec | s | times ours | peak MiB |\n|---|---|---|---|---|---|")
    ours = 'path = "{}"\n[output.o]\npath = "pyramid.zarr"\nfrom = "v"\n'
    same, peak = min(occlude("[input.v]\n" + ours.format("in_zstd.zarr") + zstd) for _ in range(2))
    theirs = best(lambda: tensorstore_pyramid(FOLDER / "in_zstd.zarr" / "0"))
    check("level 1", FOLDER / "pyramid.zarr" / "1", FOLDER / "ts.zarr" / "1", 1)
    row("pyramid", "occlude", "zstd 1, chunks of 64", same, note=f"{peak:.0f}")
    row("pyramid", "TensorStore", "zstd 1, chunks of 64", theirs, same)
    default, peak = min(occlude("[input.v]\n" + ours.format("in.zarr")) for _ in range(2))
    row("pyramid", "occlude", "defaults", default, note=f"{peak:.0f}")
    row("pyramid", "TensorStore", "zstd 1, chunks of 64", theirs, default)
    box = '[input.v]\npath = "in_zstd.zarr"\n[stage.s]\nop = "box"\ninput = "v"\nradius = 5\n'
    for name, hi in (("mean", 255), ("variance", 2550)):
        box += f'[output.{name}]\npath = "{name}.zarr"\nfrom = "s.{name}"\nlevels = 1\ndtype = "u8"\nrange = [0, {hi}]\n'
        box += zstd
    same, peak = min(occlude(box, ["run.memory=256MiB"]) for _ in range(2))
    theirs = best(lambda: tensorstore_box(FOLDER / "in_zstd.zarr" / "0"))
    for name in ("mean", "variance"):
        check(name, FOLDER / f"{name}.zarr" / "0", FOLDER / f"ts_{name}.zarr", 1)
    row("mean and variance, radius 5", "occlude, 256 MiB", "zstd 1, chunks of 64", same, note=f"{peak:.0f}")
    row("mean and variance, radius 5", "TensorStore and numba", "zstd 1, chunks of 64", theirs, same)
    for path in FOLDER.glob("*.zarr"):
        shutil.rmtree(path)


main()
