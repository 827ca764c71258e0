#!/usr/bin/env python3
"""Random graphs over random volumes, judged by the formulas in plain NumPy.

    random_configs.py PATH_TO_OCCLUDE [FIRST [COUNT]]

Each case has its own seed: one small volume (any type, byte order and file format that needs no library but zarr; slope,
intercept, nodata, NaN), one to four stages in a chain, and three runs. The first writes every channel as it is; a stage is
judged by what it makes of the inputs *as the run wrote them*, so that nothing adds up along the chain. The second writes
pyramids alone, in other bricks, and is judged by the channels of the first. The third covers a region and must equal the
first there, byte for byte. Exit code 1 if any case fails; the seed of a failure runs it again.
"""

import itertools
import json
import math
import pathlib
import subprocess
import sys
import tempfile

import further
import numpy as np
import zarr
from numpy.lib.stride_tricks import sliding_window_view
from scipy.special import ndtr

PROGRAM = pathlib.Path(sys.argv[1]).resolve()
TYPES = ("u1", "i1", "<u2", ">u2", "<i2", ">i2", "<u4", "<i4", ">i4", "<f4", ">f4", "<f8")
EXTENDED = np.longdouble
METHODS = ("exact", "cdf_power", "gaussian_cdf", "chebyshev", "chebyshev_literal")


class Field:
    """Values of an input or a channel: stored, exact in f64; what scales them; which voxels exist."""

    def __init__(self, stored, slope=1.0, intercept=0.0, valid=None):
        self.dtype, self.v = stored.dtype.newbyteorder("="), stored.astype(np.float64)
        self.slope, self.intercept = slope, intercept
        self.valid = ~np.isnan(self.v) if valid is None else valid
        self.plain = (slope, intercept) == (1, 0)
        self.result = np.dtype("f8" if self.dtype.str[1:] in ("u4", "i4", "f8") else "f4")
        self.scaled = np.where(self.valid, self.v * slope + intercept, np.nan)


# Formulas. Each stage gives {channel: (values, absolute tolerance)}; voxels that are missing in `ok` become NaN.


def windows(v, valid, radius, border, constant):
    """The values of every window and which of them count."""
    radius = [min(r, n - 1) if border == "clip" else r for r, n in zip(radius, v.shape)]
    width = [(r, r) for r in radius]
    if border in ("clip", "constant"):
        v, valid = np.pad(v, width, constant_values=constant), np.pad(valid, width, constant_values=border == "constant")
    else:
        mode = {"nearest": "edge", "reflect": "symmetric"}[border]
        v, valid = np.pad(v, width, mode=mode), np.pad(valid, width, mode=mode)
    size = [2 * r + 1 for r in radius]
    flat = lambda a: sliding_window_view(a, size).reshape([n - 2 * r for n, r in zip(a.shape, radius)] + [-1])
    return flat(v), flat(valid)


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
    loose = (1e-5 if f.result == "f4" else 1e-9) if f.dtype.kind == "f" else 4 * once
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


def ambient_occlusion(f, stage, _):
    border, constant = stage["_border"]
    sign = (1 if f.slope > 0 else -1) * (-1 if stage.get("solid") == "low" else 1)
    w, m = windows(f.v * sign, f.valid, stage["radius"], border, sign * (constant - f.intercept) / f.slope)
    v, n, method = f.v * sign, np.maximum(m.sum(-1), 1), stage["method"]
    low, high = np.where(m, w, np.inf).min(-1), np.where(m, w, -np.inf).max(-1)
    mid = stage.get("ties") == "mid"
    if method == "exact":
        le, lt = (m & (w <= v[..., None])).sum(-1) / n, (m & (w < v[..., None])).sum(-1) / n
        return {"openness": ((le + lt) / 2 if mid else le, 1e-7)}
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


def gaussian(f, stage, _):
    radius = [math.ceil(3 * s) for s in stage["sigma"]]
    offset = np.median(f.v[f.valid]) if f.valid.any() else 0.0
    weight, first = f.valid.astype(EXTENDED), np.where(f.valid, f.v.astype(EXTENDED) - offset, 0)
    parts = [weight, first, first**2]
    for axis, (r, sigma) in enumerate(zip(radius, stage["sigma"])):
        taps = np.exp(-0.5 * (np.arange(-r, r + 1, dtype=EXTENDED) / sigma) ** 2)
        width = [(r, r) if a == axis else (0, 0) for a in range(3)]
        parts = [(sliding_window_view(np.pad(p, width), 2 * r + 1, axis=axis) * taps).sum(-1) for p in parts]
    with np.errstate(all="ignore"):
        mean, square = parts[1] / parts[0], parts[2] / parts[0]
    spread = np.nanmax(np.abs(first), initial=0) * abs(f.slope)
    eps = np.finfo(f.result).eps
    mean_scaled = f.slope * (mean + offset) + f.intercept
    return {
        "mean": (mean_scaled, 4 * eps * (np.abs(mean_scaled) + spread)),
        "variance": (f.slope**2 * np.maximum(square - mean**2, 0), 1e-5 * f.slope**2 * square + (4 * eps * spread) ** 2),
    }


def gradient(f, stage, case):
    g = np.moveaxis(further.regression(f.scaled, case.spacing, stage["size"], stage["weight"] == "inverse"), -1, 0)
    reach = (np.nanmax(f.scaled) - np.nanmin(f.scaled)) / min(case.spacing) if f.valid.any() else 0
    top = np.nanmax(np.abs(f.scaled), initial=0) / min(case.spacing)
    tolerance = reach * (2e-5 if not f.valid.all() else 4 * np.finfo(f.result).eps) + 1e-14 * top
    return {"magnitude": (np.sqrt((g * g).sum(0)), tolerance), "vector": (g, tolerance)}


def first_occluder(v, valid, w, spacing, reach):
    """Planes to the first larger voxel along the lattice lines of direction w (x, y, z), 0 where there is none, and a step."""
    u = w[::-1] / spacing
    a = max(range(3), key=lambda i: (round(abs(u[i]), 12), -i))
    sign, m = (1 if u[a] > 0 else -1), u / abs(u[a])
    step = float(np.linalg.norm(spacing * m)) / min(spacing)
    others = [b for b in range(3) if b != a]
    v, valid = np.moveaxis(v, a, 0), np.moveaxis(valid, a, 0)
    planes = np.zeros(v.shape, int)
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
        planes[i][here][hit] = j
    return np.moveaxis(planes, 0, a), step


def obscurance(f, stage, case):
    sign = (1 if f.slope > 0 else -1) * (-1 if stage.get("solid") == "low" else 1)
    reach, directions = stage["max_distance"], further.icosahedron(stage["directions"])
    total = np.zeros(f.v.shape)
    for w in directions:
        planes, step = first_occluder(np.where(f.valid, f.v * sign, 0), f.valid, w, np.array(case.spacing), reach)
        t = planes * step / reach
        value = {"step": 0 * t, "linear": t, "exponential": 1 - np.exp(-t), "sqrt": np.sqrt(t)}[stage["rho"]]
        total += np.where(planes > 0, value, 1) / len(directions)
    return {"openness": (total, 1.2e-6)}


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


STAGES = {f.__name__: f for f in (box, ambient_occlusion, gaussian, gradient, obscurance, transfer, combine, window)}


class Case:
    def __init__(self, seed, folder):
        self.folder, self.rng, self.failures = folder, np.random.default_rng(seed), []
        self.spacing = [self.pick(1.0, 2.0, 0.5, 0.7) for _ in range(3)] if self.chance(0.4) else [1.0] * 3
        self.fields, self.stages, self.needed, self.native = {}, {}, {}, {}
        self.input = self.make_input()
        self.shape, self.names = self.fields["a"].v.shape, ["a"]
        for i in range(self.pick(1, 1, 2, 3, 4)):
            self.add_stage(f"s{i}")

    def pick(self, *choices):
        return choices[self.rng.integers(len(choices))]

    def chance(self, p):
        return self.rng.random() < p

    def volume(self):
        sizes = (1, 2, 3, 5, 8, 9, 13, 17)
        shape = (9999,) * 3
        while np.prod(shape) > 1500:
            shape = tuple(self.pick(*sizes) for _ in range(3))
        dtype, kind = np.dtype(self.pick(*TYPES)), self.pick("full", "few", "one odd", "step", "noise")
        few, at = self.rng.integers(0, 5, shape), np.indices(shape)[2] > shape[2] // 2
        if dtype.kind == "f":
            v = {"full": self.rng.normal(size=shape) * 1e3, "few": few * 0.25, "one odd": (few == 9) * 1.0,
                 "step": at * 1e6 + self.rng.normal(size=shape), "noise": self.rng.normal(size=shape) + 1000}[kind]
            v = v.astype(dtype)
            v[self.rng.random(shape) < self.pick(0, 0, 0.05, 0.6)] = np.nan
        else:
            info = np.iinfo(dtype)
            base = self.pick(info.min, info.max - 5, 20)
            v = {"full": self.rng.integers(info.min, info.max, shape, endpoint=True), "few": base + few, "one odd": base + 0 * few,
                 "step": np.where(at, info.max, base), "noise": self.rng.integers(10, 100, shape)}[kind].astype(dtype)
        if kind == "one odd":
            v[tuple(n // 2 for n in shape)] += 1
        return v

    def make_input(self):
        v, format = self.volume(), self.pick("npy", "raw", "zarr2", "zarr3")
        keys = {"path": f"a.{format}", "spacing": self.spacing}
        if format == "npy":
            np.save(self.folder / "a.npy", np.asfortranarray(v) if self.chance(0.3) else v)
        elif format == "raw":
            (self.folder / "a.raw").write_bytes(b"head" + v.tobytes())
            word = {"u": "u", "i": "i", "f": "f"}[v.dtype.kind] + str(8 * v.dtype.itemsize)
            endian = "big" if v.dtype.byteorder == ">" else "little"
            keys |= {"format": "raw", "shape": list(v.shape), "dtype": word, "offset": 4, "endian": endian}
        else:
            chunks = tuple(self.pick(1, 3, 4, 8) for _ in range(3))
            shards = tuple(c * self.pick(1, 2) for c in chunks) if format == "zarr3" and self.chance(0.5) else None
            native = v.astype(v.dtype.newbyteorder("="))
            array = zarr.create_array(str(self.folder / keys["path"]), shape=v.shape, chunks=chunks, shards=shards, dtype=native.dtype,
                                      zarr_format=int(format[-1]), fill_value=native.flat[0])
            array[:] = native
        slope, intercept = (self.pick(2.0, -1.0, -0.25), self.pick(0.0, 10.0)) if self.chance(0.35) else (1.0, 0.0)
        valid = ~np.isnan(v.astype(float))
        if self.chance(0.3) and valid.any():
            gone = self.rng.choice(v[valid])
            keys["nodata"], valid = gone.item(), valid & (v != gone)
        if (slope, intercept) != (1, 0):
            keys |= {"slope": slope, "intercept": intercept}
        self.fields["a"] = Field(v, slope, intercept, valid)
        return keys

    def add_stage(self, name):
        op = self.pick(*STAGES, "box", "ambient_occlusion", "ambient_occlusion")
        stage, source = {"op": op}, self.pick(*self.names[-4:])
        stage |= {"inputs": [source, self.pick(*self.names)]} if op == "combine" else {"input": source}
        channels = {"box": ["mean", "min", "max", "variance", "std", "moment2"], "ambient_occlusion": ["openness"], "gaussian": ["mean", "variance"],
                    "gradient": ["magnitude", "vector"], "obscurance": ["openness"], "transfer": ["opacity", "rgb"], "combine": ["value"], "window": ["openness"]}[op]
        if op in ("box", "ambient_occlusion"):
            border = self.pick("clip", "clip", "nearest", "reflect", "constant")
            stage["radius"], stage["_border"] = [self.pick(0, 1, 2, 3, *([40] if border == "clip" else [])) for _ in range(3)], (border, 7.0)
            if border != "clip":
                stage["border"] = {"constant": 7.0} if border == "constant" else border
        if op == "ambient_occlusion":
            stage |= {"method": self.pick(*METHODS), "ties": self.pick("le", "mid"), "solid": self.pick("high", "low")}
        elif op == "gaussian":
            stage["sigma"] = [self.pick(0.3, 0.7, 1.5) for _ in range(3)]
        elif op == "gradient":
            stage |= {"size": self.pick(3, 5), "weight": self.pick("distance", "inverse")}
        elif op == "obscurance":
            stage |= {"directions": self.pick(12, 42), "rho": self.pick("step", "linear", "exponential", "sqrt"),
                      "max_distance": self.pick(2.0, 5.0, 64.0), "solid": self.pick("high", "low")}
        elif op == "transfer":
            stage["points"] = [[x] + self.rng.random(4).round(3).tolist() for x in (-50.0, 0.25, 0.75, 90.0)]
        elif op == "combine":
            stage["op_kind"] = self.pick("add", "multiply", "min", "max", "mean")
        elif op == "window":
            stage |= {"low": 0.2013, "high": 0.7017, "mode": self.pick("keep", "stretch")}
        finite = self.fields["a"].scaled[self.fields["a"].valid]
        if self.chance(0.3) and finite.size:
            stage |= {"where": {"input": "a", self.pick("min", "max"): float(np.quantile(finite, 0.4)) + 0.0625}, "fill": self.pick(0.25, -7.0)}
        self.stages[name] = stage | {"_channels": channels}
        self.names += [f"{name}.{c}" for c in channels if c not in ("vector", "rgb")]

    def run(self, run, outputs, *flags):
        word = lambda v: "{ " + ", ".join(f"{k} = {word(x)}" for k, x in v.items()) + " }" if isinstance(v, dict) else json.dumps(v)
        tables = {"run": run, "input.a": self.input} | {f"stage.{k}": s for k, s in self.stages.items()} | {f"output.{k}": o for k, o in outputs.items()}
        lines = (f"[{t}]\n" + "".join(f"{k} = {word(v)}\n" for k, v in keys.items() if k[0] != "_") for t, keys in tables.items())
        (self.folder / "c.toml").write_text("".join(lines))
        done = subprocess.run([PROGRAM, "run", self.folder / "c.toml", "-q", "--overwrite", *flags], capture_output=True, text=True)
        if done.returncode != 0:
            self.failures.append(f"exit {done.returncode}: {done.stderr.strip()}")
        return done.returncode == 0

    def judge(self, what, got, want, tolerance, where=True):
        got, want = got.astype(EXTENDED), np.asarray(want, EXTENDED)
        if got.shape != want.shape:
            return self.failures.append(f"{what}: shape {got.shape}, expected {want.shape}")
        with np.errstate(all="ignore"):
            good = (got == want) | (np.isnan(got) & np.isnan(want)) | (np.abs(got - want) <= tolerance + 1e-37) | ~np.broadcast_to(where, got.shape)
        if not good.all():
            at = tuple(np.argwhere(~good)[0])
            self.failures.append(f"{what}: {(~good).sum()} of {good.size} voxels, {float(got[at])!r} at {at}, expected {float(want[at])!r}")

    def judge_stage(self, name):
        stage = self.stages[name]
        sources = [self.fields[s] for s in stage.get("inputs", [stage.get("input")])]
        a, where = self.fields["a"], stage.get("where", {})
        need = ~(a.scaled < where.get("min", -np.inf)) & ~(a.scaled > where.get("max", np.inf)) & (a.valid | (not where))
        self.needed[name] = need
        ok = np.all([f.valid for f in sources], axis=0)
        for channel, (want, tolerance) in STAGES[stage["op"]](sources[0], stage, self).items():
            got = self.native[f"{name}.{channel}"]
            fill = stage.get("fill", 0.0)
            whole = got.dtype.kind in "iu"
            if whole:  # a missing voxel stays missing for later stages; what stands in its place says nothing
                fill = float(np.clip(np.rint(fill), np.iinfo(got.dtype).min, np.iinfo(got.dtype).max))
                # A fill that is the stored value of missing voxels reads as missing.
                self.fields[f"{name}.{channel}"].valid = np.where(need, ok, fill != self.input.get("nodata"))
            want = np.where(need, np.where(ok, want, np.nan), fill)
            # The regression of a window that does not span space has no one answer.
            self.judge(f"{name} {stage['op']} {channel}", got, want, np.where(need, tolerance, 1e-6), ~(whole & ~ok & need) & self.spanned(stage, sources[0]))
            kept = channel in ("min", "max") and sources[0].plain and stage["_border"][0] != "constant"
            if stage["op"] == "box" and got.dtype != (sources[0].dtype if kept else got.dtype if channel in ("min", "max") else sources[0].result):
                self.failures.append(f"{name} {channel}: type {got.dtype}")

    def spanned(self, stage, f):
        if stage["op"] != "gradient" or f.valid.all():
            return True
        h = stage["size"] // 2
        return sliding_window_view(np.pad(f.valid, h, mode="edge"), (2 * h + 1,) * 3).mean((3, 4, 5)) > 0.6

    def judge_pyramid(self, name, output):
        """Levels by total factors, from the channel as the first run wrote it."""
        stage, channel = output["from"].split(".")
        f, need = self.fields[output["from"]], self.needed[stage]
        ok, fill, reduce = need & f.valid, self.stages[stage].get("fill", 0.0), output.get("reduce", "mean")
        group = zarr.open_group(str(self.folder / output["path"]), mode="r")
        image, codes = group.attrs["ome"]["multiscales"][0], output["dtype"] == "u8"
        factor, n, spacing = np.array([1, 1, 1]), np.array(f.v.shape), np.array(self.spacing)
        for k in itertools.count():
            what, last = f"{name} {output['from']} {reduce} level {k}", (n <= output["chunk"]).all() or (n == 1).all()
            if k == len(image["datasets"]):
                return self.failures.append(f"{what}: missing")
            scale, move = [t[t["type"]] for t in image["datasets"][k]["coordinateTransformations"]]
            if not np.allclose(scale, spacing * factor, 1e-15) or not np.allclose(move, spacing * (factor - 1) / 2, 1e-14):
                self.failures.append(f"{what}: scale {scale}, translation {move}")
            room = [(0, int(m * q - s)) for m, q, s in zip(n, factor, f.v.shape)]
            split = [x for m, q in zip(n, factor) for x in (int(m), int(q))]
            cells = lambda a: np.pad(a, room).reshape(split).transpose(0, 2, 4, 1, 3, 5).reshape(tuple(n) + (-1,))
            v, m, out = cells(np.where(ok, f.v, 0)).astype(EXTENDED), cells(ok), cells(~need)
            count = np.maximum(m.sum(-1), 1)
            if reduce == "moments":
                mean = cells(np.where(ok, self.fields[f"{stage}.mean"].v, 0)).astype(EXTENDED)
                middle = average(mean, m, count)
                want = average(v * v if channel == "std" else v, m, count) + average((mean - middle[..., None]) ** 2, m, count)
                want = np.sqrt(want) if channel == "std" else want
                loose = 1e-5 * want + 1e-6 * np.abs(mean).max(-1)
            else:
                want = {"mean": average(v, m, count), "min": np.where(m, v, np.inf).min(-1), "max": np.where(m, v, -np.inf).max(-1)}[reduce]
                loose = 1e-6 * np.abs(v).max(-1)
            want, sure = np.where(m.any(-1), want, np.where(out.any(-1), fill, np.nan)), m.any(-1) | out.all(-1) | ~out.any(-1)
            got = group[str(k)][:]
            if got.dtype.kind in "iu" and not codes:  # of integer channels: rounded, and nothing said of missing voxels
                want, loose, sure = np.clip(want, np.iinfo(got.dtype).min, np.iinfo(got.dtype).max), loose + 0.5, m.any(-1)
            elif codes:
                want, loose, sure = 255 * np.clip(want, 0, 1), 255 * loose + 0.5 + 255 * 2e-4, m.any(-1)
            self.judge(what, got, want, loose, sure)
            if last:
                return None
            live = [spacing[b] * factor[b] for b in range(3) if n[b] > 1]
            halve = np.array([n[b] > 1 and spacing[b] * factor[b] < 2 * min(live) * (1 - 1e-9) for b in range(3)])
            n, factor = np.where(halve, (n + 1) // 2, n), np.where(halve, 2 * factor, factor)

    def judge_all(self):
        channels = {f"{s}.{c}": f"{s}_{c}" for s, stage in self.stages.items() for c in stage["_channels"]}
        outputs = {o: {"path": f"{o}.npy", "from": c, "dtype": "native"} for c, o in channels.items()}
        if not self.run({"memory": "256MiB", "brick": self.pick(4, 8, 16), "threads": 1}, outputs):
            return
        for channel, output in channels.items():
            self.native[channel] = np.load(self.folder / f"{output}.npy")
            self.fields[channel] = Field(self.native[channel])
        for name in self.stages:
            self.judge_stage(name)
        pyramids = {}
        for i, channel in enumerate(self.pick(*self.names[1:]) for _ in range(2)):
            kind = channel.split(".")[1]
            reduce = self.pick("mean", *([kind] if kind in ("min", "max") else ["moments"] if channel.startswith("s") and kind in ("variance", "std") else []))
            dtype = "u8" if kind == "openness" and self.chance(0.5) else "native"
            chunk = self.pick(2, 4, 8)
            pyramids[f"z{i}"] = {"path": f"z{i}.zarr", "from": channel, "dtype": dtype, "reduce": reduce, "chunk": chunk, "shard": self.pick(chunk, 2 * chunk, "none")}
        brick = [self.pick(1, 3, 8, 32) for _ in range(3)]
        if self.run({"memory": "128MiB", "brick": brick, "threads": 2}, pyramids, *self.pick(["--no-skip"], [])):
            for name, output in pyramids.items():
                self.judge_pyramid(name, output)
        region = [sorted(self.rng.choice(n + 1, 2, replace=False).tolist()) for n in self.shape]
        if self.run({"memory": "256MiB", "brick": self.pick(3, 8), "region": region}, outputs):
            for channel, output in channels.items():
                part, whole = np.load(self.folder / f"{output}.npy"), self.native[channel]
                if part.tobytes() != np.ascontiguousarray(whole[(..., *(slice(*r) for r in region))]).tobytes():
                    self.failures.append(f"{channel} under region {region} differs from the whole run")


def main():
    first = int(sys.argv[2]) if len(sys.argv) > 2 else 0
    count = int(sys.argv[3]) if len(sys.argv) > 3 else 100
    failed = 0
    for seed in range(first, first + count):
        with tempfile.TemporaryDirectory() as folder:
            case = Case(seed, pathlib.Path(folder))
            case.judge_all()
            failed += bool(case.failures)
            for failure in case.failures:
                print(f"seed {seed}, {case.fields['a'].dtype} {case.shape}: {failure}")
            if case.failures:
                print((case.folder / "c.toml").read_text())
    print(f"{count - failed} random configs passed, {failed} failed")
    sys.exit(failed > 0)


main()
