#!/usr/bin/env python3
"""Whole cdf_power and Chebyshev maps by SciPy, OpenCV and numba beside occlude, one thread each, on the same data.

    pip install numpy scipy opencv-python-headless numba
    cargo build --release && python benches/rivals.py target/release/occlude [volume.npy]

Without a volume, a synthetic head of 256x256x415 u16. Every rival's map must agree with ours within 1e-5 (f32 arithmetic
of a rival is said in its row), else it is not timed. Times are the best of three; ours is the stage's time in the report
of a run with one thread, so files and process start are left out on both sides.
"""

import json
import pathlib
import subprocess
import sys
import tempfile
import time

import numpy as np

RADIUS = 10


def volume():
    if len(sys.argv) > 2:
        return np.load(sys.argv[2])
    z, y, x = np.meshgrid(*[np.linspace(-0.5, 0.5, n) for n in (415, 256, 256)], indexing="ij", sparse=True)
    r = np.sqrt(z * z + y * y + x * x)
    rng = np.random.default_rng(1)
    return np.where(r > 0.45, 0, 1000 + 200 * np.sin(40 * z) * np.cos(30 * x) + rng.integers(0, 64, r.shape)).astype("u2")


def counts(shape):
    sides = [np.minimum(np.arange(n), RADIUS) + np.minimum(np.arange(n)[::-1], RADIUS) + 1 for n in shape]
    return sides[0][:, None, None] * sides[1][:, None] * sides[2]


def finish_power(v, lo, hi, mean):
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (v - lo) / (hi - lo)
        beta = np.clip((mean - lo) / (hi - mean), 1e-6, 1e6)
        out = t**beta
    return np.where(lo == hi, 1, out)


def finish_chebyshev(v, mean, var):
    with np.errstate(divide="ignore", invalid="ignore"):
        # A window of equal values is open; integers of a window vary by more than 1e-6 or not at all.
        return np.where(var < 1e-6, 1, np.where(v <= mean, 0, 1 - var / (var + (v - mean) ** 2)))


def scipy_maps(v):
    from scipy.ndimage import maximum_filter, minimum_filter, uniform_filter

    size = 2 * RADIUS + 1
    d = v.astype(np.float64)
    share = counts(v.shape) / size**3

    def mean_of(x):
        return uniform_filter(x, size, mode="constant") / share

    def power():
        lo, hi = minimum_filter(v, size, mode="nearest"), maximum_filter(v, size, mode="nearest")
        return finish_power(d, lo.astype(float), hi.astype(float), mean_of(d))

    def chebyshev():
        mean = mean_of(d)
        return finish_chebyshev(d, mean, np.maximum(mean_of(d * d) - mean * mean, 0))

    return power, chebyshev


def numba_maps(v):
    import numba

    @numba.njit(fastmath=False)
    def sums(src, out):  # running sums along the last axis
        n = src.shape[2]
        for z in range(src.shape[0]):
            for y in range(src.shape[1]):
                s = 0.0
                for x in range(min(RADIUS, n)):
                    s += src[z, y, x]
                for x in range(n):
                    if x + RADIUS < n:
                        s += src[z, y, x + RADIUS]
                    if x > RADIUS:
                        s -= src[z, y, x - RADIUS - 1]
                    out[z, y, x] = s

    @numba.njit
    def sums_rows(src, out, axis):  # along y or z, a whole row at a time
        m = src.shape[0] if axis == 1 else src.shape[1]
        n = src.shape[1] if axis == 1 else src.shape[0]
        row = np.zeros(src.shape[2])
        for k in range(m):
            row[:] = 0
            for j in range(min(RADIUS, n)):
                row += src[k, j] if axis == 1 else src[j, k]
            for j in range(n):
                if j + RADIUS < n:
                    row += src[k, j + RADIUS] if axis == 1 else src[j + RADIUS, k]
                if j > RADIUS:
                    row -= src[k, j - RADIUS - 1] if axis == 1 else src[j - RADIUS - 1, k]
                if axis == 1:
                    out[k, j] = row
                else:
                    out[j, k] = row

    @numba.njit
    def chebyshev_rows(v, s1, s2, n, out):
        for z in range(v.shape[0]):
            for y in range(v.shape[1]):
                for x in range(v.shape[2]):
                    mean = s1[z, y, x] / n[z, y, x]
                    var = max(s2[z, y, x] / n[z, y, x] - mean * mean, 0.0)
                    d = v[z, y, x] - mean
                    out[z, y, x] = 1.0 if var < 1e-6 else 0.0 if d <= 0 else 1 - var / (var + d * d)

    n = counts(v.shape).astype(np.float64)
    a, b = np.empty(v.shape), np.empty(v.shape)

    def total(x):
        sums(x, a)
        sums_rows(a, b, 1)
        out = np.empty(v.shape)
        sums_rows(b, out, 0)
        return out

    def chebyshev():
        d = v.astype(np.float64)
        out = np.empty(v.shape)
        chebyshev_rows(d, total(d), total(d * d), n, out)
        return out

    return None, chebyshev


def opencv_maps(v):
    import cv2

    cv2.setNumThreads(1)
    size = 2 * RADIUS + 1
    kernel = np.ones((size, size), np.uint8)

    def axes(f, x):
        y = np.stack([f(p) for p in x])
        flat = y.reshape(x.shape[0], -1)
        return flat, y.shape

    def extreme(x, op):
        flat, shape = axes(lambda p: op(p, kernel), x)
        return op(flat, np.ones((size, 1), np.uint8)).reshape(shape)

    def mean_of(x):
        flat, shape = axes(lambda p: cv2.boxFilter(p, -1, (size, size), normalize=False, borderType=cv2.BORDER_CONSTANT), x)
        return cv2.boxFilter(flat, -1, (1, size), normalize=False, borderType=cv2.BORDER_CONSTANT).reshape(shape) / counts(v.shape)

    def power():
        d = v.astype(np.float64)
        return finish_power(d, extreme(v, cv2.erode).astype(float), extreme(v, cv2.dilate).astype(float), mean_of(d))

    return power, None


def ours(program, folder, v, method):
    np.save(folder / "v.npy", v)
    (folder / "c.toml").write_text(
        f"[run]\nthreads = 1\nmemory = '4GiB'\n[input.v]\npath = 'v.npy'\n[stage.s]\nop = 'ambient_occlusion'\ninput = 'v'\n"
        f"method = '{method}'\nradius = {RADIUS}\n[output.o]\npath = 'o.npy'\nfrom = 's'\ndtype = 'f32'\n"
    )
    best = float("inf")
    for _ in range(3):
        subprocess.run([program, "run", folder / "c.toml", "--overwrite", "-q", "--report", folder / "r.json"], check=True)
        best = min(best, json.loads((folder / "r.json").read_text())["stages"][0]["seconds"])
    return best, np.load(folder / "o.npy")


def main():
    program = pathlib.Path(sys.argv[1]).resolve()
    v = volume()
    print(f"{v.shape} {v.dtype}, radius {RADIUS}, one thread, whole map\n\n| method | by | ms | times ours |\n|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for k, method in reversed(list(enumerate(["cdf_power", "chebyshev"]))):
            mine, map_ = ours(program, pathlib.Path(folder), v, method)
            print(f"| {method} | occlude | {mine * 1e3:.0f} | 1 |")
            for name, maker in [("numba", numba_maps), ("OpenCV", opencv_maps), ("SciPy", scipy_maps)]:
                try:
                    rival = maker(v)[k]
                except ImportError:
                    print(f"| {method} | {name} | not installed | |")
                    continue
                if rival is None:
                    continue
                best, result = float("inf"), None
                for _ in range(3):
                    start = time.perf_counter()
                    result = rival()
                    best = min(best, time.perf_counter() - start)
                off = np.abs(result - map_).max()
                if off > 1e-5:
                    print(f"| {method} | {name} | differs by {off:.2g} | |")
                    continue
                print(f"| {method} | {name} | {best * 1e3:.0f} | {best / mine:.1f} |")


main()
