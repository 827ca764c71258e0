#!/usr/bin/env python3
"""Random chains of stages over one random volume, judged by the formulas in plain NumPy.

    random_configs.py PATH_TO_OCCLUDE [FIRST [COUNT]]

Each case has its own seed: one small volume (any type, byte order and file format that needs no library but zarr; slope,
intercept, nodata, NaN), one to four stages in a chain, and three runs. The first writes every channel as it is; a stage is
judged by what it makes of the inputs *as the run wrote them*, so that nothing adds up along the chain. The second writes
pyramids alone, in other bricks, and is judged by the channels of the first. The third covers a region and must equal the
first there, byte for byte. Exit code 1 if any case fails; the seed of a failure runs it again.
"""

import functools
import itertools
import json
import multiprocessing
import pathlib
import subprocess
import sys
import tempfile
import traceback

import numpy as np
import zarr
from formulas import EXTENDED, STAGES, Field, average, needed
from numpy.lib.stride_tricks import sliding_window_view

PROGRAM = pathlib.Path(sys.argv[1]).resolve()
TYPES = ("u1", "i1", "<u2", ">u2", "<i2", ">i2", "<u4", "<i4", ">i4", "<f4", ">f4", "<f8")
METHODS = ("exact", "cdf_power", "gaussian_cdf", "chebyshev", "chebyshev_literal")
OPS = ("box", "ambient_occlusion", "gaussian", "gradient", "obscurance", "transfer", "combine", "window")
CHANNELS = {"box": ["mean", "min", "max", "variance", "std", "moment2"], "ambient_occlusion": ["openness"],
            "gaussian": ["mean", "variance"], "gradient": ["magnitude", "vector"], "saliency": ["saliency"], "obscurance": ["openness"],
            "transfer": ["opacity", "rgb"], "combine": ["value"], "window": ["openness"], "opacity_modulation": ["opacity"],
            "ambient_light": ["rgb"]}


class Case:
    def __init__(self, seed, folder):
        self.folder, self.rng, self.failures, self.blamed = folder, np.random.default_rng(seed), [], ""
        self.spacing = [self.pick(1.0, 2.0, 0.5, 0.7) for _ in range(3)] if self.chance(0.4) else [1.0] * 3
        self.fields, self.stages, self.needed, self.unsure, self.native = {}, {}, {}, {}, {}
        self.inputs = {"a": self.make_input()}
        self.shape, self.names = self.fields["a"].v.shape, ["a"]
        self.make_stages()

    def make_stages(self):
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
        self.fields["a"] = Field(v, slope, intercept, valid, keys.get("nodata"))
        return keys

    def add_stage(self, name):
        op = self.pick(*OPS, "box", "ambient_occlusion", "ambient_occlusion")
        stage, source = {"op": op}, self.pick(*self.names[-4:])
        stage |= {"inputs": [source, self.pick(*self.names)]} if op == "combine" else {"input": source}
        if op in ("box", "ambient_occlusion"):
            border = self.pick("clip", "clip", "nearest", "reflect", "constant")
            stage["radius"] = [self.pick(0, 1, 2, 3, *([40] if border == "clip" else [])) for _ in range(3)]
            self.set_border(stage, border, 7.0)
        if op == "ambient_occlusion":
            stage |= {"method": self.pick(*METHODS), "ties": self.pick("le", "mid"), "solid": self.pick("high", "low")}
        elif op == "gaussian":
            stage["sigma"] = [self.pick(0.3, 0.7, 1.5) for _ in range(3)]
        elif op == "gradient":
            stage |= {"size": self.pick(3, 5), "weight": self.pick("distance", "inverse")}
        elif op == "obscurance":
            stage |= {"directions": self.pick(12, 42), "rho": self.pick("step", "linear", "exponential", "sqrt"),
                      "max_distance": self.pick(2.0, 5.0, 64.0), "solid": self.pick("high", "low")}
        self.set_point(stage)
        finite = self.fields["a"].scaled[self.fields["a"].valid]
        if self.chance(0.3) and finite.size:
            stage |= {"where": {"input": "a", self.pick("min", "max"): float(np.quantile(finite, 0.4)) + 0.0625}, "fill": self.pick(0.25, -7.0)}
        self.keep_stage(name, stage)

    def set_point(self, stage):
        """What stages that look at one voxel take; others nothing."""
        if stage["op"] == "transfer":
            stage["points"] = [[x] + self.rng.random(4).round(3).tolist() for x in (-50.0, 0.25, 0.75, 90.0)]
        elif stage["op"] == "combine":
            stage["op_kind"] = self.pick("add", "multiply", "min", "max", "mean")
        elif stage["op"] == "window":
            stage |= {"low": 0.2013, "high": 0.7017, "mode": self.pick("keep", "stretch")}

    def fail(self, what):
        self.failures.append(what)
        self.blamed = self.blamed or (self.folder / "c.toml").read_text()

    def set_border(self, stage, border, constant):
        stage["_border"] = (border, constant)
        if border != "clip":
            stage["border"] = {"constant": constant} if border == "constant" else border

    def keep_stage(self, name, stage, *more):
        channels = CHANNELS[stage["op"]] + list(more)
        self.stages[name] = stage | {"_channels": channels, "_name": name}
        self.names += [f"{name}.{c}" for c in channels if c not in ("vector", "rgb")]

    def run(self, run, outputs, *flags):
        word = lambda v: "{ " + ", ".join(f"{k} = {word(x)}" for k, x in v.items()) + " }" if isinstance(v, dict) else json.dumps(v)
        tables = {"run": run} | {f"{kind}.{k}": t for kind, group in (("input", self.inputs), ("stage", self.stages), ("output", outputs)) for k, t in group.items()}
        # What TOML says in other words than the formulas read it stands in a key _toml_KEY.
        said = lambda keys: {k: keys.get(f"_toml_{k}", v) for k, v in keys.items() if k[0] != "_"}
        lines = (f"[{t}]\n" + "".join(f"{k} = {word(v)}\n" for k, v in said(keys).items()) for t, keys in tables.items())
        (self.folder / "c.toml").write_text("".join(lines))
        done = subprocess.run([PROGRAM, "run", self.folder / "c.toml", "-q", "--overwrite", *flags], capture_output=True, text=True)
        if done.returncode != 0:
            self.fail(f"exit {done.returncode}: {done.stderr.strip()}")
        return done.returncode == 0

    def judge(self, what, got, want, tolerance, where=True):
        got, want = got.astype(EXTENDED), np.asarray(want, EXTENDED)
        if got.shape != want.shape:
            return self.fail(f"{what}: shape {got.shape}, expected {want.shape}")
        with np.errstate(all="ignore"):
            good = (got == want) | (np.isnan(got) & np.isnan(want)) | (np.abs(got - want) <= tolerance + 1e-37) | ~np.broadcast_to(where, got.shape)
        if not good.all():
            at = tuple(np.argwhere(~good)[0].tolist())
            self.fail(f"{what}: {(~good).sum()} of {good.size} voxels, {float(got[at])!r} at {at}, expected {float(want[at])!r}")

    def judge_stage(self, name):
        stage, where = self.stages[name], self.stages[name].get("where")
        every, none = np.ones(self.shape, bool), np.zeros(self.shape, bool)
        need, unsure = needed(self.fields[where["input"]].scaled, self.spacing, where) if where else (every, none)
        self.needed[name], self.unsure[name] = need, unsure
        sources = [self.fields[s] for s in stage.get("inputs", [stage.get("input")])] + [self.fields[stage[k]] for k in ("by", "rgb") if k in stage]
        ok = np.all([f.valid if f.valid.ndim == 3 else f.valid.all(0) for f in sources], axis=0)
        if any(f.infinite() for f in sources):
            return  # sums beyond a type's range, which say nothing of the stage
        for channel, (want, tolerance) in STAGES[stage["op"]](sources[0], stage, self).items():
            got, field = self.native[f"{name}.{channel}"], self.fields[f"{name}.{channel}"]
            fill = stage.get("fill", 1.0 if channel in ("openness", "lower", "upper") else 0.0)
            whole = got.dtype.kind in "iu"
            if whole:  # a missing voxel stays missing for later stages; what stands in its place says nothing
                fill = float(np.clip(np.rint(fill), np.iinfo(got.dtype).min, np.iinfo(got.dtype).max))
                # A fill that is the stored value of missing voxels reads as missing.
                field.nodata = sources[0].nodata
                field.valid = np.where(need, ok, fill != field.nodata)
            want = np.where(need, np.where(ok, want, np.nan), fill)
            self.judge(f"{name} {stage['op']} {channel}", got, want, np.where(need, tolerance, 1e-6), ~(whole & ~ok & need) & ~unsure & self.spanned(stage, sources[0]))
            kept = channel in ("min", "max") and sources[0].plain and stage["_border"][0] != "constant"
            if stage["op"] == "box" and got.dtype != (sources[0].dtype if kept else got.dtype if channel in ("min", "max") else sources[0].result):
                self.fail(f"{name} {channel}: type {got.dtype}")

    def spanned(self, stage, f):
        """Where the regression has an answer: not in a window that does not span space, nor over the largest of those."""
        if f.valid.all() or stage["op"] not in ("gradient", "saliency") and not stage.get("weight_by_normal"):
            return True
        h = stage.get("size", 3) // 2
        return sliding_window_view(np.pad(f.valid, h, mode="edge"), (2 * h + 1,) * 3).mean((3, 4, 5)) > 0.6 if stage.get("scale") != "max" else False

    def components(self, channels):
        """What each component of an output holds: name, values, valid, needed, fill, the mean beside a variance."""
        for channel in channels:
            f, stage = self.fields[channel], self.stages.get(channel.split(".")[0], {})
            need, name = self.needed.get(stage.get("_name"), np.ones(self.shape, bool)), channel.split(".")[-1]
            fill = stage.get("fill", 1.0 if name in ("openness", "lower", "upper") else 0.0)
            mean = self.fields[f"{stage['_name']}.mean"].v if name in ("variance", "std") and stage["op"] in ("box", "gaussian") else None
            fill = float(np.clip(np.rint(fill), np.iinfo(f.dtype).min, np.iinfo(f.dtype).max)) if f.dtype.kind in "iu" else fill
            for i, v in enumerate(f.v if f.v.ndim == 4 else [f.v]):
                yield f"{channel} {i}", v, need & (f.valid[i] if f.valid.ndim == 4 else f.valid), need, fill, mean

    def cells_of(self, output, component, factors, n):
        """A level of one component: values, tolerance, and where they are certain."""
        (name, f, ok, need, fill, mean), factor = component, factors[-1]
        room = [(0, int(m * q - s)) for m, q, s in zip(n, factor, f.shape)]
        split = [x for m, q in zip(n, factor) for x in (int(m), int(q))]
        cells = lambda a: np.pad(a, room).reshape(split).transpose(0, 2, 4, 1, 3, 5).reshape(tuple(n) + (-1,))
        v, m, out = cells(np.where(ok, f, 0)).astype(EXTENDED), cells(ok), cells(~need)
        count, reduce = np.maximum(m.sum(-1), 1), output.get("reduce", "mean")
        if reduce == "moments" and mean is not None:
            mean = cells(np.where(ok, mean, 0)).astype(EXTENDED)
            middle, deviation = average(mean, m, count), ".std" in name
            want = average(v * v if deviation else v, m, count) + average((mean - middle[..., None]) ** 2, m, count)
            want = np.sqrt(want) if deviation else want
            loose = 1e-5 * want + 1e-6 * np.abs(mean).max(-1)
        else:
            # A stride takes the first child that has a value, of the first child that has one, and so on.
            places = np.argwhere(np.ones(factor, bool))
            order = sorted(range(len(places)), key=lambda i: [tuple(places[i] // f) for f in factors[-2::-1]])
            first = np.take_along_axis(v[..., order], m[..., order].argmax(-1)[..., None], -1)[..., 0]
            low, high = np.where(m, v, np.inf).min(-1), np.where(m, v, -np.inf).max(-1)
            want = {"mean": average(v, m, count), "min": low, "max": high, "stride": first}[reduce]
            loose = 1e-6 * np.abs(v).max(-1)
        want = np.where(m.any(-1), want, np.where(out.any(-1), fill, np.nan))
        return want, loose, m.any(-1) | out.all(-1) | ~out.any(-1), m.any(-1)

    def judge_pyramid(self, name, output):
        """Levels by total factors, from the channels as the first run wrote them."""
        channels = output["from"] if isinstance(output["from"], list) else [output["from"]]
        parts, reduce = list(self.components(channels)), output.get("reduce", "mean")
        group = zarr.open_group(str(self.folder / output["path"]), mode="r")
        image, codes = dict(group.attrs).get("ome", dict(group.attrs))["multiscales"][0], output["dtype"] == "u8"
        factors, n, spacing = [np.array([1, 1, 1])], np.array(self.shape), np.array(self.spacing)
        for k in itertools.count():
            factor = factors[-1]
            what, last = f"{name} {reduce} level {k}", (n <= output["chunk"]).all() or (n == 1).all()
            if k == len(image["datasets"]):
                return self.fail(f"{what}: missing")
            scale, move = [t[t["type"]][-3:] for t in image["datasets"][k]["coordinateTransformations"]]
            shift = 0 * spacing if reduce == "stride" else spacing * (factor - 1) / 2
            if not np.allclose(scale, spacing * factor, 1e-15) or not np.allclose(move, shift, 1e-14):
                self.fail(f"{what}: scale {scale}, translation {move}")
            array = group[str(k)][:]
            if array.ndim == 3 and len(parts) == 1:
                array = array[None]
            if len(array) != len(parts):
                return self.fail(f"{what}: {len(array)} components, expected {len(parts)}")
            for got, part in zip(array, parts):
                want, loose, sure, counts = self.cells_of(output, part, factors, n)
                if codes:
                    want, loose, sure = 255 * np.clip(want, 0, 1), 255 * loose + 0.5 + 255 * 2e-4, counts
                elif got.dtype.kind in "iu":  # of integer channels: rounded, and nothing said of missing voxels
                    want, loose, sure = np.clip(want, np.iinfo(got.dtype).min, np.iinfo(got.dtype).max), loose + 0.5, counts
                self.judge(f"{what} {part[0]}", got, want, loose, sure)
            if last:
                return None
            live = [spacing[b] * factor[b] for b in range(3) if n[b] > 1]
            halve = np.array([n[b] > 1 and spacing[b] * factor[b] < 2 * min(live) * (1 - 1e-9) for b in range(3)])
            n = np.where(halve, (n + 1) // 2, n)
            factors.append(np.where(halve, 2 * factor, factor))

    def judge_channels(self):
        """Every channel as it is, judged stage by stage; the outputs, or None where the run failed."""
        channels = {f"{s}.{c}": f"{s}_{c}" for s, stage in self.stages.items() for c in stage["_channels"]}
        outputs = {o: {"path": f"{o}.npy", "from": c, "dtype": "native"} for c, o in channels.items()}
        if not self.run({"memory": "256MiB", "brick": self.pick(4, 8, 16), "threads": 1}, outputs):
            return None
        for channel, output in channels.items():
            self.native[channel] = np.load(self.folder / f"{output}.npy")
            self.fields[channel] = Field(self.native[channel])
        for name in self.stages:
            self.judge_stage(name)
        return outputs

    def same_again(self, outputs, run, *flags, part=...):
        """Another run of the same channels, or of a part of them, gives the same bytes."""
        if self.run(run, outputs, *flags):
            for name, output in outputs.items():
                again, first = np.load(self.folder / f"{name}.npy"), self.native[output["from"]]
                if again.tobytes() != np.ascontiguousarray(first[part]).tobytes():
                    self.fail(f"{output['from']} differs from the first run under {run} {flags}")

    def same_region(self, outputs):
        region = [sorted(self.rng.choice(n + 1, 2, replace=False).tolist()) for n in self.shape]
        run = {"memory": "256MiB", "brick": self.pick(3, 8), "region": region}
        self.same_again(outputs, run, part=(..., *(slice(*r) for r in region)))

    def judge_all(self):
        outputs = self.judge_channels()
        if outputs is None:
            return
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
        self.same_region(outputs)


def outcome(kind, seed):
    """What is wrong with a case, as text; empty where nothing is."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            case = kind(seed, pathlib.Path(folder))
            case.judge_all()
        except Exception:
            return f"seed {seed}: {traceback.format_exc()}"
        heads = [f"seed {seed}, {case.fields['a'].dtype} {case.shape}: {failure}" for failure in case.failures]
        return "\n".join(heads + [case.blamed])


def campaign(kind, count):
    """Runs the cases that the command line asks for, `count` of them where it does not say, and leaves."""
    first = int(sys.argv[2]) if len(sys.argv) > 2 else 0
    count = int(sys.argv[3]) if len(sys.argv) > 3 else count
    failed = 0
    with multiprocessing.Pool() as pool:
        for text in pool.imap(functools.partial(outcome, kind), range(first, first + count)):
            failed += bool(text)
            if text:
                print(text, flush=True)
    print(f"{count - failed} random configs passed, {failed} failed")
    sys.exit(failed > 0)


if __name__ == "__main__":
    campaign(Case, 100)
