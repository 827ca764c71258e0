"""Checks for interop.py that were found by a second reading of the formulas: each of them once failed, or guards a corner
that no other check looks into. `stage(folder, source, body, channel)` runs one stage; `close` compares."""

import itertools
import json
import math
from fractions import Fraction

import numpy as np
from formulas import first_occluder, icosahedron, regression
from scipy.spatial import SphericalVoronoi

RNG = np.random.default_rng(20261126)


def weights(folder, stage, close):
    """Obscurance weighed by the normal, by Voronoi cells, and by both: one component, whatever weighs it."""
    for name, dtype, spacing in [("u8", "u1", (1.0, 1.0, 1.0)), ("f32", "<f4", (2.5, 1.0, 0.7))]:
        v = RNG.integers(0, 60, (6, 7, 5)).astype(dtype)
        if dtype == "<f4":
            v[RNG.random(v.shape) < 0.08] = np.nan
        np.save(folder / "a.npy", v)
        d, spacing = v.astype(float), np.array(spacing)
        points = icosahedron(42)
        normal = -regression(d, spacing, 3, True)
        length = np.linalg.norm(normal, axis=-1)
        area = SphericalVoronoi(points, 1, np.zeros(3)).calculate_areas()
        reach = 4.0
        value = []
        for w in points:
            planes, _, step = first_occluder(np.nan_to_num(d), ~np.isnan(d), w, spacing, reach)
            value.append(np.where(planes > 0, np.sqrt(planes * step / reach), 1.0))
        for facing in (False, True):
            for cells in (False, True):
                total, norm = np.zeros(v.shape), np.zeros(v.shape)
                for w, o, cell in zip(points, value, area if cells else np.ones(len(points))):
                    share = np.full(v.shape, cell)
                    if facing:
                        cosine = np.divide(normal @ w[::-1], length, out=np.zeros(v.shape), where=length > 0)
                        share = np.where(length > 0, cell * np.maximum(cosine, 0), cell)
                    total += share * o
                    norm += share
                want = np.where(np.isnan(d), np.nan, total / norm)
                keys = f"weight_by_normal = {json.dumps(facing)}\nweights = '{'voronoi' if cells else 'uniform'}'"
                body = f"op = 'obscurance'\nmax_distance = 4\n{keys}"
                got = stage(folder, f"path = 'a.npy'\nspacing = {spacing.tolist()}", body)
                close(f"obscurance {name} normal {facing} voronoi {cells}", got, want, 1e-6)


def holes(folder, stage, close):
    """Gradients beside missing voxels: the full regression over the others."""
    v = RNG.normal(size=(6, 7, 8)).astype("<f4")
    v[RNG.random(v.shape) < 0.1] = np.nan
    np.save(folder / "a.npy", v)
    for size, weight in itertools.product((3, 5), ("distance", "inverse")):
        want = np.moveaxis(regression(v.astype(float), (2.0, 1.0, 0.5), size, weight == "inverse"), -1, 0)
        body = f"op = 'gradient'\nsize = {size}\nweight = '{weight}'"
        got = stage(folder, "path = 'a.npy'\nspacing = [2.0, 1.0, 0.5]", body, "s.vector")
        close(f"gradient with holes {size} {weight}", got, want, 2e-5)


def rounded(folder, stage, close):
    """Moments of integers against fractions: rounded once, to the very bit."""
    r = 1
    for name in ("u1", "i1", "<u2", "<i2", "<u4", "<i4"):
        info = np.iinfo(name)
        v = RNG.integers(info.min, info.max, (5, 6, 7), dtype=np.dtype(name).newbyteorder("="), endpoint=True)
        np.save(folder / "a.npy", v.astype(name))
        to = np.float64 if v.dtype.itemsize == 4 else np.float32
        want = {c: np.empty(v.shape) for c in ("mean", "variance", "moment2")}
        for p in np.ndindex(v.shape):
            w = [int(x) for x in v[tuple(slice(max(0, i - r), i + r + 1) for i in p)].ravel()]
            mean, square = Fraction(sum(w), len(w)), Fraction(sum(x * x for x in w), len(w))
            want["mean"][p], want["variance"][p], want["moment2"][p] = to(mean), to(square - mean * mean), to(square)
        for channel, expected in want.items():
            got = stage(folder, "path = 'a.npy'", f"op = 'box'\nradius = {r}", f"s.{channel}")
            close(f"{name} {channel} rounded once", got, expected, 0)


def scaled(folder, stage, close):
    """Negative slope, intercept and nodata through windows, ranks, gradients and masks at once."""
    v = RNG.integers(-50, 50, (6, 7, 8)).astype("<i2")
    np.save(folder / "a.npy", v)
    s = np.where(v == -7, np.nan, -1.5 * v + 10)
    source = "path = 'a.npy'\nslope = -1.5\nintercept = 10\nnodata = -7"
    pad = np.pad(s, 1, constant_values=7.0)
    mean = np.array([np.nanmean(pad[tuple(slice(i, i + 3) for i in p)]) for p in np.ndindex(s.shape)]).reshape(s.shape)
    needed = (s >= -10) & (s <= 40)
    body = "op = 'box'\nradius = 1\nborder = { constant = 7.0 }\nwhere = { input = 'a', min = -10, max = 40 }\nfill = -77"
    close("scaled mean under a mask", stage(folder, source, body), np.where(needed, mean, -77), 1e-5)
    clip = np.pad(s, 2, constant_values=np.nan)
    rank = np.full(s.shape, np.nan)
    for p in np.ndindex(s.shape):
        w = clip[tuple(slice(i, i + 5) for i in p)]
        if not np.isnan(s[p]):
            rank[p] = ((w >= s[p]).sum() + (w > s[p]).sum()) / (2 * (~np.isnan(w)).sum())
    body = "op = 'ambient_occlusion'\nmethod = 'exact'\nradius = 2\nsolid = 'low'\nties = 'mid'"
    close("scaled rank of the low side", stage(folder, source, body), rank, 1e-6)
    want = np.linalg.norm(regression(s, (1, 1, 1), 5, False), axis=-1)
    close("scaled gradient with nodata", stage(folder, source, "op = 'gradient'"), want, 1e-4)
    for slope in ("0", "nan"):
        got = stage(folder, f"path = 'a.npy'\nslope = {slope}\nintercept = 5", "op = 'box'\nradius = 0")
        close(f"slope {slope} means 1 and 0", got, v, 0)


def halves(folder, stage, close):
    """Codes of values half way between two."""
    v = np.arange(51, dtype="u1").reshape(1, 3, 17)
    np.save(folder / "a.npy", v)
    got = stage(folder, "path = 'a.npy'", "op = 'box'\nradius = 0", dtype="u8", range=[0, 50])
    close("half codes", got, np.rint(v / 50 * 255), 0)


def canonical(window, centre):
    """Bounds of the numbers of voxels below `centre` and not above it: the distribution with the window's moments 0 to 4
    that has the centre for a node, by exact fractions up to the roots. None where the moments are those of fewer points."""
    x = [Fraction(float(v)) - Fraction(float(centre)) for v in window]
    m = [sum(v**k for v in x) for k in range(5)]
    rows = [[m[i + j] for j in range(3)] + [Fraction(i == 0)] for i in range(3)]  # Hankel matrix, powers of the centre: 1, 0, 0
    for i in range(3):
        pivot = next((r for r in range(i, 3) if rows[r][i]), None)
        if pivot is None:
            return None
        rows[i], rows[pivot] = rows[pivot], rows[i]
        rows[i] = [v / rows[i][i] for v in rows[i]]
        for r in (r for r in range(3) if r != i):
            rows[r] = [a - rows[r][i] * b for a, b in zip(rows[r], rows[i])]
    c = [row[3] for row in rows]
    at_centre = 1 / c[0]
    nodes = np.sort_complex(np.roots([float(v) for v in c[::-1]])).real
    # The other weights from the first two moments.
    weights = np.linalg.solve(np.array([nodes, nodes**2]), [float(m[1]), float(m[2])]) if len(nodes) == 2 else [0.0]
    lower = sum(w for w, node in zip(weights, nodes) if node < 0)
    return lower, lower + float(at_centre)


def bounds(folder, stage, close):
    """The exact count lies between `lower` and `upper`, which are what four moments allow, and `openness` in the middle."""
    shape, r = (6, 7, 9), 2
    volumes = {
        "u8": RNG.integers(0, 256, shape).astype("u1"),
        "u8 two values": (RNG.random(shape) < 0.3).astype("u1") * 7,
        "u8 tail": (255 * RNG.random(shape) ** 9).astype("u1"),
        "i16": RNG.integers(-32768, 32768, shape).astype("<i2"),
        "u16 top": (65535 - RNG.integers(0, 9, shape)).astype("<u2"),
        "u16 outlier": np.where(RNG.random(shape) < 0.01, 65535, RNG.integers(0, 9, shape)).astype("<u2"),
        "f32": RNG.normal(size=shape).astype("<f4"),
        "f64": 1e6 + RNG.normal(size=shape),
        "i32": RNG.integers(-(2**31), 2**31, shape).astype("<i4"),
    }
    for name, v in volumes.items():
        np.save(folder / "a.npy", v)
        wide, mark = v.dtype.itemsize > 2, np.sort(v.ravel())[-3]
        for ties, solid in itertools.product(("le", "mid"), ("high", "low")):
            # A voxel is missing where the value marks it; slopes below 0 turn the order once more.
            source = "path = 'a.npy'\nslope = -0.5" + ("" if v.dtype.kind == "f" else f"\nnodata = {int(mark)}")
            gone = np.zeros(shape, bool) if v.dtype.kind == "f" else v == mark
            body = f"op = 'ambient_occlusion'\nradius = {r}\nties = '{ties}'\nsolid = '{solid}'\nmethod = "
            exact = stage(folder, source, body + "'exact'")
            lower, open_, upper = (stage(folder, source, body + "'moments4'", f"s.{c}") for c in ("lower", "openness", "upper"))
            what = f"moments4 {name} {ties} {solid}"
            have = ~gone
            assert (np.isnan(lower) == gone).all() and (np.isnan(open_) == gone).all(), what
            assert (lower[have] <= exact[have]).all() and (exact[have] <= upper[have]).all(), f"{what}: a bound does not hold"
            assert (lower[have] >= 0).all() and (upper[have] <= 1).all(), what
            close(f"{what} middle", open_, (lower.astype(float) + upper) / 2, 1e-6)
            if "two values" in name:
                close(f"{what} known exactly", open_, exact, 1e-6)
                continue
            d = np.where(gone, np.nan, v.astype(float)) * (1 if solid == "low" else -1)
            want = np.full((2,) + shape, np.nan)
            for p in np.ndindex(shape):
                w = d[tuple(slice(max(0, i - r), i + r + 1) for i in p)].ravel()
                w = w[~np.isnan(w)]
                found = None if gone[p] else canonical(w, d[p])
                if found is not None:
                    # Counts are whole, and the centre is one that is not above itself.
                    more, less = (1, 0) if ties == "le" else (0.5, 0.5)
                    want[0][p] = (found[0] + more) / len(w)
                    want[1][p] = (found[1] - less) / len(w)
            judged = ~np.isnan(want[0])
            assert judged.mean() > 0.5, what
            # Bounds are made whole, which is less than a voxel of 24 at least; wide types have 65535 steps.
            one = 1 / 24 + (0.02 if wide else 0)
            got = np.where(judged, [lower, upper], np.nan)
            close(f"{what} bounds", got, want, one)


def opposed(folder, stage, close):
    """Windows that hold both infinities: 1 and 0 at them, `fill` beside them, NaN at missing voxels alone."""
    v = RNG.normal(size=(5, 6, 12)).astype("<f4")
    v[2, 3, 4], v[2, 3, 6], v[1, 3, 5] = np.inf, -np.inf, np.nan
    np.save(folder / "a.npy", v)
    both = np.zeros(v.shape, bool)
    both[1:4, 2:5, 5] = True
    for method in ("cdf_power", "gaussian_cdf", "chebyshev", "chebyshev_literal", "beta"):
        got = stage(folder, "path = 'a.npy'", f"op = 'ambient_occlusion'\nmethod = '{method}'\nradius = 1\nfill = 0.25")
        want = np.where(np.isnan(v), np.nan, np.where(both, 0.25, got))
        want[2, 3, 4], want[2, 3, 6] = 1, 0
        close(f"{method} between infinities", got, want, 0)


def stored(folder, stage, close):
    """Stages that look at one voxel take inputs in scaled units, and their missing voxels as missing."""
    v = RNG.integers(0, 256, (3, 4, 5)).astype("u1")
    v[0, 0, 0] = 9
    np.save(folder / "a.npy", v)
    s = np.where(v == 9, np.nan, 1 - v / 255)
    source = f"path = 'a.npy'\nslope = {-1 / 255}\nintercept = 1\nnodata = 9"
    body = "op = 'window'\nlow = 0.2001\nhigh = 0.7001"
    close("window of a scaled input", stage(folder, source, body), np.where(s < 0.2001, 0, np.where(s > 0.7001, 1, s)), 1e-6)
    body = "op = 'opacity_modulation'\nby = 'a'\nsigma_max2 = 0.5"
    close("modulation of a scaled input", stage(folder, source, body), s * np.minimum(s / 0.5, 1), 1e-6)
    # Missing voxels hold `fill` in integers too, whatever their range turns out to be.
    v = v.astype("<i2") - 100
    np.save(folder / "a.npy", v)
    got = stage(folder, "path = 'a.npy'\nnodata = -91", "op = 'box'\nradius = 0\nfill = 30", dtype="u16", range="auto")
    low, high = v[v != -91].min(), v[v != -91].max()
    close("missing voxels by a range found", got, np.rint((np.where(v == -91, 30, v) - low) / (high - low) * 65535), 0)


def beyond(folder, stage, close):
    """Constant borders: bricks of one value inside the volume, and constants that the input's type cannot hold."""
    v = RNG.integers(0, 9, (36, 35, 37)).astype("u1")
    v[14:34, 14:34, 14:34] = 5
    np.save(folder / "a.npy", v)
    for constant in (7.0, 7.5):
        pad = np.pad(v.astype(float), 1, constant_values=constant)
        near = [pad[tuple(slice(i, i + n) for i, n in zip(o, v.shape))] for o in itertools.product(range(3), repeat=3)]
        border = f"radius = 1\nborder = {{ constant = {constant} }}"
        for channel, want in (("min", np.min(near, 0)), ("max", np.max(near, 0)), ("mean", np.mean(near, 0))):
            got = stage(folder, "path = 'a.npy'", f"op = 'box'\n{border}", f"s.{channel}")
            close(f"{channel} beside a border of {constant}", got, want, 1e-6)
        got = stage(folder, "path = 'a.npy'", f"op = 'ambient_occlusion'\nmethod = 'exact'\n{border}")
        close(f"rank beside a border of {constant}", got, np.mean(np.array(near) <= v, axis=0), 1e-6)


def run_all(folder, stage, close):
    for part in (weights, holes, rounded, scaled, halves, bounds, opposed, stored, beyond):
        part(folder, stage, close)
