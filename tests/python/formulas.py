"""The formulas of every stage in plain NumPy, for the scripts beside this one.

A stage's function takes (field, stage, case): its input, its keys (those that begin with _ are not TOML: `_border` is the pair
of border and constant, `_name` the stage's), and who knows the other fields (`fields`), the spacing and what the run wrote (`native`). It gives
{channel: (values, absolute tolerance)}; voxels that are missing in the input may hold anything.
"""

import itertools
import math
from fractions import Fraction

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.spatial import ConvexHull, SphericalVoronoi, cKDTree
from scipy.special import ndtr

EXTENDED = np.longdouble


class Field:
    """Values of an input or a channel: stored, exact in f64; what scales them; which voxels exist."""

    def __init__(self, stored, slope=1.0, intercept=0.0, valid=None, nodata=None):
        self.dtype, self.v = stored.dtype.newbyteorder("="), stored.astype(np.float64)
        self.slope, self.intercept, self.nodata = slope, intercept, nodata
        self.valid = ~np.isnan(self.v) if valid is None else valid
        self.plain = (slope, intercept) == (1, 0)
        self.result = np.dtype("f8" if self.dtype.str[1:] in ("u4", "i4", "f8") else "f4")
        self.scaled = np.where(self.valid, self.v * slope + intercept, np.nan)

    def infinite(self):
        return bool(np.isinf(self.v[self.valid]).any())


def windows(v, valid, radius, border, constant):
    """The values of every window and which of them count."""
    radius = [min(r, n - 1) if border == "clip" else r for r, n in zip(radius, v.shape)]
    v, valid = bordered(v, valid, radius, border, constant)
    size = [2 * r + 1 for r in radius]
    flat = lambda a: sliding_window_view(a, size).reshape([n - 2 * r for n, r in zip(a.shape, radius)] + [-1])
    return flat(v), flat(valid)


def bordered(v, valid, radius, border, constant):
    width = [(r, r) for r in radius]
    if border in ("clip", "constant"):
        return np.pad(v, width, constant_values=constant), np.pad(valid, width, constant_values=border == "constant")
    mode = {"nearest": "edge", "reflect": "symmetric"}[border]
    return np.pad(v, width, mode=mode), np.pad(valid, width, mode=mode)


def average(values, counts, n):
    return np.where(counts, values, 0).sum(-1) / n


def box(f, stage, _):
    border, constant = stage["_border"]
    v, m = windows(f.v, f.valid, stage["radius"], border, (constant - f.intercept) / f.slope)
    n, x = np.maximum(m.sum(-1), 1), v.astype(EXTENDED) - f.v[..., None]  # exact, and nothing cancels
    x = np.where(m, x, 0)
    near = average(x, m, n)
    mean = f.v + near
    variance = f.slope**2 * average((x - near[..., None]) ** 2, m, n)
    low, high = np.where(m, v, np.inf).min(-1), np.where(m, v, -np.inf).max(-1)
    low, high = (low, high) if f.slope > 0 else (high, low)
    scale = lambda a: f.slope * a.astype(EXTENDED) + f.intercept
    once = np.finfo(f.result).eps * 0.51
    # Beside a border of no integer, integers of 32 bits are f64 like the constant.
    few = 16 if border == "constant" and f.result == "f8" and (constant - f.intercept) / f.slope % 1 else 4
    loose = (1e-5 if f.result == "f4" else 1e-9) if f.dtype.kind == "f" else few * once
    # Where results are f64, so is what they are made of: a few steps, of the largest value.
    size = np.abs(f.slope * np.where(m, v, 0)).max(-1) + abs(f.intercept)
    moment2 = variance + scale(mean) ** 2
    return {
        "mean": (scale(mean), once * np.abs(scale(mean)) + 1e-15 * size),
        "min": (scale(low), 0 if f.plain else 1e-7 * np.abs(scale(low))),
        "max": (scale(high), 0 if f.plain else 1e-7 * np.abs(scale(high))),
        "variance": (variance, loose * variance),
        "std": (np.sqrt(variance), loose * np.sqrt(variance)),
        "moment2": (moment2, 2 * once * moment2 + 2e-15 * size**2),
    }


def equal_volume(radius):
    """Half the box whose side is the odd number nearest to 0.806 (2 r + 1), at least 3."""
    side = min(range(3, 2 * radius + 4, 2), key=lambda s: abs(s - 0.806 * (2 * radius + 1)))
    return side // 2 if radius else 0


def in_ball(radius, used):
    """Which voxels of a window of half-widths `used` lie in the ellipsoid of `radius`."""
    offsets = itertools.product(*(range(-r, r + 1) for r in used))
    share = lambda d: sum(Fraction(x * x, r * r) for x, r in zip(d, radius) if r)
    return np.array([share(d) <= 1 for d in offsets])


def ambient_occlusion(f, stage, case):
    (border, constant), region, radius = stage["_border"], stage.get("region", "box"), stage["radius"]
    if region == "equal_volume":
        radius = [equal_volume(r) for r in radius]
    sign = (1 if f.slope > 0 else -1) * (-1 if stage.get("solid") == "low" else 1)
    w, m = windows(f.v * sign, f.valid, radius, border, sign * (constant - f.intercept) / f.slope)
    if region == "ball":
        inside = in_ball(radius, [min(r, n - 1) if border == "clip" else r for r, n in zip(radius, f.v.shape)])
        w, m = w[..., inside], m[..., inside]
    v, n, method = f.v * sign, np.maximum(m.sum(-1), 1), stage["method"]
    mid = stage.get("ties") == "mid"
    if method in ("exact", "levels", "moments4"):
        le, lt = (m & (w <= v[..., None])).sum(-1) / n, (m & (w < v[..., None])).sum(-1) / n
        exact = (le + lt) / 2 if mid else le
        return counted(method, exact, f, stage, case)
    low, high = np.where(m, w, np.inf).min(-1), np.where(m, w, -np.inf).max(-1)
    d = np.where(m, w.astype(EXTENDED) - v[..., None], 0)
    shift = average(d, m, n)  # mean - v
    variance = average((d - shift[..., None]) ** 2, m, n)
    with np.errstate(all="ignore"):
        if method == "cdf_power":
            below, above, width = v - low.astype(EXTENDED), high.astype(EXTENDED) - v, high.astype(EXTENDED) - low
            beta = np.clip((shift + below) / (above - shift), 1e-6, 1e6)
            log = np.where(above < width / 2, np.log1p(-above / width), np.log(below / width))
            o = np.where(below == 0, 0, np.where(above == 0, 1, np.exp(beta * log)))
        elif method == "gaussian_cdf":
            o = ndtr((-shift / np.sqrt(variance)).astype(float))
        else:
            p = np.where(shift >= 0, 1, variance / (variance + shift**2))
            o = 1 - p if method == "chebyshev" else p
    return {"openness": (np.where(low == high, 0.5 if mid else 1, o), 1e-5)}


def counted(method, exact, f, stage, case):
    """The method that counts, and the two that approach it."""
    if method == "exact":
        return {"openness": (exact, 1e-7)}
    if method == "levels":  # one level per value, where there are no more values than levels
        known = len(np.unique(f.v[f.valid])) <= 32
        return {"openness": (exact if known else np.full(exact.shape, 0.5), 1e-6 if known else 0.5)}
    lower, upper = (case.native[f"{stage['_name']}.{c}"].astype(float) for c in ("lower", "upper"))
    # The bounds hold the count; what they are is for `further.bounds` to judge.
    return {"openness": ((lower + upper) / 2, 1e-6), "lower": (np.minimum(lower, exact), 0), "upper": (np.maximum(upper, exact), 0)}


def gaussian(f, stage, case):
    border, constant = stage.get("_border", ("clip", 0.0))
    radius = [math.ceil(3 * s) for s in stage["sigma"]]
    if border == "clip":
        radius = [min(r, n - 1) for r, n in zip(radius, f.v.shape)]
    offset = np.median(f.v[f.valid]) if f.valid.any() else 0.0
    constant = EXTENDED(constant - f.intercept) / EXTENDED(f.slope) - offset
    first, weight = bordered(np.where(f.valid, f.v.astype(EXTENDED) - offset, 0), f.valid, radius, border, constant)
    weight = weight.astype(EXTENDED)
    parts = [weight, weight * first, weight * first**2]
    for axis, (r, s) in enumerate(zip(radius, stage["sigma"])):
        taps = np.exp(-0.5 * (np.arange(-r, r + 1, dtype=EXTENDED) / s) ** 2)
        parts = [(sliding_window_view(p, 2 * r + 1, axis=axis) * taps).sum(-1) for p in parts]
    with np.errstate(all="ignore"):
        mean, square = parts[1] / parts[0], parts[2] / parts[0]
    spread = np.nanmax(np.abs(first), initial=0) * abs(f.slope)
    eps = np.finfo(f.result).eps
    mean_scaled = f.slope * (mean + offset) + f.intercept
    return {
        "mean": (mean_scaled, 4 * eps * (np.abs(mean_scaled) + spread)),
        "variance": (f.slope**2 * np.maximum(square - mean**2, 0), 1e-5 * f.slope**2 * square + (4 * eps * spread) ** 2),
    }


def regression(v, spacing, size, inverse):
    """The gradient by weighted linear regression, with the full normal equations where a voxel is missing."""
    h = size // 2
    pad = np.pad(v, h, mode="edge")
    offsets = np.array(list(itertools.product(range(-h, h + 1), repeat=3)))
    x = offsets * np.array(spacing, float)
    distance = np.linalg.norm(x, axis=1)
    weight = np.divide(1, distance, out=np.zeros_like(distance), where=distance > 0) if inverse else distance
    out = np.full(v.shape + (3,), np.nan)
    for p in np.ndindex(v.shape):
        if np.isnan(v[p]):
            continue
        f = pad[tuple(slice(i, i + size) for i in p)].ravel()
        have = ~np.isnan(f)
        if have.all():
            out[p] = ((weight * f) @ x) / (weight @ x**2)
            continue
        a = np.c_[x, np.ones(len(x))][have] * np.sqrt(weight[have])[:, None]
        out[p] = np.linalg.lstsq(a, f[have] * np.sqrt(weight[have]), rcond=None)[0][:3]
    return out


def gradient(f, stage, case):
    g = np.moveaxis(regression(f.scaled, case.spacing, stage["size"], stage["weight"] == "inverse"), -1, 0)
    reach = (np.nanmax(f.scaled) - np.nanmin(f.scaled)) / min(case.spacing) if f.valid.any() else 0
    top = np.nanmax(np.abs(f.scaled), initial=0) / min(case.spacing)
    tolerance = reach * (2e-5 if not f.valid.all() else 4 * np.finfo(f.result).eps) + 1e-14 * top
    return {"magnitude": (np.sqrt((g * g).sum(0)), tolerance), "vector": (g, tolerance)}


def saliency(f, stage, case):
    magnitude, tolerance = gradient(f, stage, case)["magnitude"]
    counts = f.valid & case.needed[stage["_name"]]
    if stage.get("scale") == "max" and counts.any() and magnitude[counts].max() > 0:
        largest = magnitude[counts].max()
        magnitude, tolerance = magnitude / largest, 3 * tolerance / largest + 1e-6
    return {"saliency": (magnitude, tolerance)}


def icosahedron(n):
    g = (1 + math.sqrt(5)) / 2
    points = np.array([np.roll((0, a, b * g), k) for a in (1, -1) for b in (1, -1) for k in range(3)])
    points /= np.linalg.norm(points[0])
    while len(points) < n:
        edges = {tuple(sorted(e)) for t in ConvexHull(points).simplices for e in itertools.combinations(t, 2)}
        middles = np.array([points[a] + points[b] for a, b in sorted(edges)])
        points = np.vstack([points, middles / np.linalg.norm(middles, axis=1)[:, None]])
    return points


def first_occluder(v, valid, w, spacing, reach):
    """Of each voxel the first larger one along the lattice lines of direction w (x, y, z): planes to it, 0 where there is
    none, and its flat index; then the distance of a plane in units of the finest spacing."""
    u = w[::-1] / spacing
    a = max(range(3), key=lambda i: (round(abs(u[i]), 12), -i))
    sign, m = (1 if u[a] > 0 else -1), u / abs(u[a])
    step = float(np.linalg.norm(spacing * m)) / min(spacing)
    others = [b for b in range(3) if b != a]
    index = np.moveaxis(np.arange(v.size).reshape(v.shape), a, 0)
    v, valid = np.moveaxis(v, a, 0), np.moveaxis(valid, a, 0)
    planes, found = np.zeros(v.shape, int), np.zeros(v.shape, int)
    at = lambda k, b: math.floor(k * m[b] + 0.5)
    for i, j in itertools.product(range(len(v)), range(1, min(math.floor(reach / step + 1e-9), len(v)) + 1)):
        to = i + sign * j
        if not 0 <= to < len(v):
            continue
        shift = [at(sign * i + j, b) - at(sign * i, b) for b in others]
        if any(abs(s) >= n for s, n in zip(shift, v.shape[1:])):
            continue
        here = tuple(slice(max(0, -s), n - max(0, s)) for s, n in zip(shift, v.shape[1:]))
        there = tuple(slice(max(0, s), n - max(0, -s)) for s, n in zip(shift, v.shape[1:]))
        hit = (planes[i][here] == 0) & valid[to][there] & (v[to][there] > v[i][here])
        planes[i][here][hit], found[i][here][hit] = j, index[to][there][hit]
    return np.moveaxis(planes, 0, a), np.moveaxis(found, 0, a), step


def direction_weights(f, stage, case, points):
    """A weight for each direction and voxel, before they are made to add up to one; and where no normal is to be trusted."""
    cells = SphericalVoronoi(points, 1, np.zeros(3)).calculate_areas() if stage.get("weights") == "voronoi" else np.ones(len(points))
    if not stage.get("weight_by_normal"):
        return [np.full(f.v.shape, cell) for cell in cells], np.zeros(f.v.shape, bool)
    solid = f.scaled * (-1 if stage.get("solid") == "low" else 1)
    normal = -regression(solid, case.spacing, 3, True)
    length = np.linalg.norm(normal, axis=-1)
    cosine = lambda w: np.divide(normal @ w[::-1], length, out=np.ones(f.v.shape), where=length > 0)
    noise = 1e-4 * (np.nanmax(solid) - np.nanmin(solid)) / min(case.spacing) if f.valid.any() else 0
    weights = [np.where(length > 0, cell * np.maximum(cosine(w), 0), cell) for w, cell in zip(points, cells)]
    return weights, (length > 0) & (length < noise)


def obscurance(f, stage, case):
    sign = (1 if f.slope > 0 else -1) * (-1 if stage.get("solid") == "low" else 1)
    reach, points = stage["max_distance"], icosahedron(stage["directions"])
    colour = case.fields[stage["colour"]].v if "colour" in stage else None
    ambient = np.array(stage.get("ambient", [1.0, 1.0, 1.0]))[:, None, None, None]
    openness, rgb, norm = np.zeros(f.v.shape), np.zeros((3,) + f.v.shape), np.zeros(f.v.shape)
    weights, vague = direction_weights(f, stage, case, points)
    for w, weight in zip(points, weights):
        planes, found, step = first_occluder(np.where(f.valid, f.v * sign, 0), f.valid, w, np.array(case.spacing), reach)
        t = planes * step / reach
        value = {"step": 0 * t, "linear": t, "exponential": 1 - np.exp(-t), "sqrt": np.sqrt(t)}[stage["rho"]]
        openness += weight * np.where(planes > 0, value, 1)
        norm += weight
        if colour is not None:
            rgb += weight * np.where(planes > 0, value * colour.reshape(3, -1)[:, found], ambient)
    result = {"openness": (openness / norm, np.where(vague, 1, 1.2e-6))}
    return result if colour is None else result | {"rgb": (rgb / norm, np.where(vague, np.inf, 2e-5))}


def transfer(f, stage, _):
    points = np.array(stage["points"])
    at = lambda c: np.interp(f.scaled, points[:, 0], points[:, c])
    steep = max([0.0] + [np.abs(q - p)[1:].max() / (q - p)[0] for p, q in zip(points, points[1:])])
    tolerance = 2e-7 + steep * 1e-13 * np.nanmax(np.abs(f.scaled), initial=0)
    return {"opacity": (at(1), tolerance), "rgb": (np.array([at(2), at(3), at(4)]), tolerance)}


def combine(_, stage, case):
    s = np.stack([case.fields[name].scaled for name in stage["inputs"]])
    joins = {"add": np.sum, "multiply": np.prod, "min": np.min, "max": np.max, "mean": np.mean}
    size = np.abs(s).prod(0) if stage["op_kind"] == "multiply" else np.abs(s).sum(0)
    return {"value": (joins[stage["op_kind"]](s, axis=0), 3e-7 * size)}


def window(f, stage, _):
    s, low, high = f.scaled, stage["low"], stage["high"]
    between = s if stage["mode"] == "keep" else (s - low) / (high - low)
    return {"openness": (np.where(s < low, 0, np.where(s > high, 1, between)), 1e-6)}


def opacity_modulation(f, stage, case):
    by = case.fields[stage["by"]].scaled
    if "sigma_max2" in stage:
        opacity = f.scaled * np.clip(by / stage["sigma_max2"], 0, 1)  # no variance is negative
        return {"opacity": (opacity, 1e-6 * np.abs(opacity) + 1e-7)}
    return {"opacity": (np.clip(f.scaled * np.where(by < stage["threshold"], 0, by) * stage["gain"], 0, 1), 1e-6)}


def ambient_light(f, stage, case):
    rgb = stage["k"] * f.scaled * case.fields[stage["rgb"]].scaled
    return {"rgb": (rgb, 1e-6 * np.abs(rgb) + 1e-7)}


STAGES = {f.__name__: f for f in (box, ambient_occlusion, gaussian, gradient, saliency, obscurance, transfer, combine, window,
                                  opacity_modulation, ambient_light)}


def needed(values, spacing, where):
    """Which voxels `where` needs, and of which its formula does not decide (on the rim of a band)."""
    if "iso" not in where:
        return (values >= where.get("min", -np.inf)) & (values <= where.get("max", np.inf)), np.zeros(values.shape, bool)
    unit, crossings = np.array(spacing) / min(spacing), []
    for iso, axis in itertools.product(np.atleast_1d(where["iso"]), range(3)):
        a, b = values.swapaxes(0, axis)[:-1], values.swapaxes(0, axis)[1:]
        with np.errstate(all="ignore"):
            share = ((iso - a) / (b - a)).swapaxes(0, axis)
        crossed = (((a < iso) & (iso <= b)) | ((b < iso) & (iso <= a))).swapaxes(0, axis)
        at = np.argwhere(crossed).astype(float)
        at[:, axis] += share[crossed]
        crossings.append(at * unit)
    crossings = np.vstack(crossings)
    if not len(crossings):
        return np.zeros(values.shape, bool), np.zeros(values.shape, bool)
    voxels = np.argwhere(np.ones(values.shape, bool)) * unit
    distance = cKDTree(crossings).query(voxels)[0].reshape(values.shape)
    return (distance <= where["band"]) & ~np.isnan(values), np.abs(distance - where["band"]) < 1e-5
