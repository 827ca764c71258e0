#!/usr/bin/env python3
"""Whole cdf_power and Chebyshev maps by SciPy, OpenCV and numba beside occlude, one thread each, on the same data.

    pip install numpy scipy opencv-python-headless numba
    cargo build --release && python benches/rivals.py target/release/occlude [volume.npy]

Without a volume, a synthetic head of 256x256x415 u16. Every rival's map must agree with ours within 1e-5 (f32 arithmetic
of a rival is said in its row), else it is not timed. Times are the best of three; ours is the stage's time in the report
of a run with one thread, so files and process start are left out on both sides.
"""

import json
import math
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

    # cdf_power by hand: all loops are flat over rows, which LLVM turns into vectors. A window of 21 is five overlapping
    # windows of 5, and padding by the edge voxels clips windows for extremes.
    @numba.njit
    def extremes_rows(lo, hi, step, out_lo, out_hi, work_lo, work_hi):  # windows of 21 elements `step` apart
        n = out_lo.size
        for i in range(n + 16 * step):
            a, b, c, d, e = lo[i], lo[i + step], lo[i + 2 * step], lo[i + 3 * step], lo[i + 4 * step]
            work_lo[i] = min(min(min(a, b), min(c, d)), e)
            a, b, c, d, e = hi[i], hi[i + step], hi[i + 2 * step], hi[i + 3 * step], hi[i + 4 * step]
            work_hi[i] = max(max(max(a, b), max(c, d)), e)
        for i in range(n):
            j, k, l, m = i + 5 * step, i + 10 * step, i + 15 * step, i + 16 * step
            out_lo[i] = min(min(min(work_lo[i], work_lo[j]), min(work_lo[k], work_lo[l])), work_lo[m])
            out_hi[i] = max(max(max(work_hi[i], work_hi[j]), max(work_hi[k], work_hi[l])), work_hi[m])

    @numba.njit
    def power_volume(v, out):
        nz, ny, nx = v.shape
        w, px = 2 * RADIUS + 1, nx + 2 * RADIUS
        # A strip of rows at a time goes through z, its sums run from plane to plane.
        zlo, zhi = np.empty((ny + 2 * RADIUS, nx), v.dtype), np.empty((ny + 2 * RADIUS, nx), v.dtype)
        zsum, wide = np.zeros((ny, nx), np.uint32), np.empty(px, np.uint32)
        ylo, yhi = np.empty((ny, px), v.dtype), np.empty((ny, px), v.dtype)
        work_lo, work_hi = np.empty((ny + 2 * RADIUS) * px + 64, v.dtype), np.empty((ny + 2 * RADIUS) * px + 64, v.dtype)
        xlo, xhi = np.empty(ny * px, v.dtype), np.empty(ny * px, v.dtype)
        row, five_lo, five_hi = np.empty(nx, np.uint32), np.empty((nz + 4, nx), v.dtype), np.empty((nz + 4, nx), v.dtype)
        vlo, vhi = np.empty((nz, ny, nx), v.dtype), np.empty((nz, ny, nx), v.dtype)
        for y in range(ny):  # along z, row by row
            for z in range(-2, nz + 2):
                a = [v[min(max(z + j, 0), nz - 1), y] for j in range(-2, 3)]
                p, q, r, s, t = a[0], a[1], a[2], a[3], a[4]
                fl, fh = five_lo[z + 2], five_hi[z + 2]
                for x in range(nx):
                    fl[x] = min(min(min(p[x], q[x]), min(r[x], s[x])), t[x])
                    fh[x] = max(max(max(p[x], q[x]), max(r[x], s[x])), t[x])
            for z in range(nz):
                i, j = min(max(z - 8, -2), nz + 1) + 2, min(max(z - 3, -2), nz + 1) + 2
                k, l, m = min(z + 2, nz + 1) + 2, min(z + 7, nz + 1) + 2, min(z + 8, nz + 1) + 2
                ol, oh = vlo[z, y], vhi[z, y]
                for x in range(nx):
                    ol[x] = min(min(min(five_lo[i, x], five_lo[j, x]), min(five_lo[k, x], five_lo[l, x])), five_lo[m, x])
                    oh[x] = max(max(max(five_hi[i, x], five_hi[j, x]), max(five_hi[k, x], five_hi[l, x])), five_hi[m, x])
        for z in range(-RADIUS, nz):
            if z + RADIUS < nz:
                new = v[z + RADIUS]
                for y in range(ny):
                    for x in range(nx):
                        zsum[y, x] += new[y, x]
            if z > RADIUS:
                old = v[z - RADIUS - 1]
                for y in range(ny):
                    for x in range(nx):
                        zsum[y, x] -= old[y, x]
            if z < 0:
                continue
            for y in range(ny + 2 * RADIUS):
                k = min(max(y - RADIUS, 0), ny - 1)
                zlo[y], zhi[y] = vlo[z, k], vhi[z, k]
            extremes_rows(zlo.reshape(-1), zhi.reshape(-1), nx, xlo[: ny * nx], xhi[: ny * nx], work_lo, work_hi)
            for y in range(ny):
                for x in range(px):
                    k = min(max(x - RADIUS, 0), nx - 1)
                    ylo[y, x], yhi[y, x] = xlo[y * nx + k], xhi[y * nx + k]
            flat = ny * px - 2 * RADIUS
            extremes_rows(ylo.reshape(-1), yhi.reshape(-1), 1, xlo[:flat], xhi[:flat], work_lo, work_hi)
            row[:] = 0
            for y in range(RADIUS):
                row += zsum[y]
            cz = min(z, RADIUS) + min(nz - 1 - z, RADIUS) + 1
            for y in range(ny):
                if y + RADIUS < ny:
                    row += zsum[y + RADIUS]
                if y > RADIUS:
                    row -= zsum[y - RADIUS - 1]
                cy = min(y, RADIUS) + min(ny - 1 - y, RADIUS) + 1
                s = np.uint32(0)
                for x in range(RADIUS):
                    s += row[x]
                for x in range(nx):
                    if x + RADIUS < nx:
                        s += row[x + RADIUS]
                    if x > RADIUS:
                        s -= row[x - RADIUS - 1]
                    wide[x] = s
                for x in range(nx):
                    n = np.float32(cz * cy * (min(x, RADIUS) + min(nx - 1 - x, RADIUS) + 1))
                    l, h = np.float32(xlo[y * px + x]), np.float32(xhi[y * px + x])
                    c, mean = np.float32(v[z, y, x]), np.float32(np.float64(wide[x]) / np.float64(n))
                    if l == h:
                        out[z, y, x] = 1
                    elif c == l:
                        out[z, y, x] = 0
                    else:
                        beta = min(max((mean - l) / (h - mean), np.float32(1e-6)), np.float32(1e6))
                        out[z, y, x] = math.exp(beta * math.log1p((c - h) / (h - l)))

    def power():
        out = np.empty(v.shape, np.float32)
        power_volume(v, out)
        return out

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

    return power, chebyshev


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
