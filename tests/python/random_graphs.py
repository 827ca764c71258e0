#!/usr/bin/env python3
"""Random graphs of stages, stage feeding stage, judged by the formulas in plain NumPy.

    random_graphs.py PATH_TO_OCCLUDE [FIRST [COUNT]]

Wider than random_configs.py: up to three inputs of their own types, two to seven stages that read any of those before them,
every border of every window, windows and reaches in millimetres, masks and isosurfaces of inputs and of channels, colours,
and pyramids of several channels. Stages are judged by what they make of their inputs as the first run wrote them; a second
run in other bricks, threads and memory, and one of a region, must give the same bytes, and so must a second run of the
pyramids, whose levels are judged by the channels. Exit code 1 if any case fails; the seed of a failure runs it again.
"""

import math

import numpy as np
import zarr
from formulas import Field
from random_configs import METHODS, TYPES, Case, campaign

OPS = ("box", "box", "ambient_occlusion", "ambient_occlusion", "ambient_occlusion", "gaussian", "gaussian", "gradient", "saliency",
       "obscurance", "obscurance", "transfer", "transfer", "combine", "window", "opacity_modulation", "ambient_light")
UNITS = {"mm": 1, "um": 1000, "cm": 0.1}


class Graph(Case):
    def make_stages(self):
        self.inputs["a"]["unit"] = "mm"
        if self.chance(0.5):
            self.add_input("b", self.values())
            self.names.append("b")
        if self.chance(0.4):
            self.add_input("m", self.mask())
        for i in range(self.pick(2, 3, 4, 5, 6, 7)):
            self.add_stage(f"s{i}")

    def add_input(self, name, v):
        np.save(self.folder / f"{name}.npy", v)
        self.inputs[name], self.fields[name] = {"path": f"{name}.npy", "spacing": self.spacing, "unit": "mm"}, Field(v)

    def values(self):
        dtype = np.dtype(self.pick(*TYPES))
        if dtype.kind != "f":
            return self.rng.integers(0, self.pick(3, 100), self.shape).astype(dtype)
        v = (self.rng.normal(size=self.shape) * self.pick(1, 1e3) + self.pick(0, 1e5)).astype(dtype)
        v[self.rng.random(self.shape) < self.pick(0, 0.1)] = np.nan
        return v

    def mask(self):
        """Voxels strewn about, a box, or nothing."""
        v = (self.rng.random(self.shape) < self.pick(0.1, 0.5, 0.0)).astype("u1")
        if self.chance(0.5):
            v[:] = 0
            v[tuple(slice(n // 3, n // 3 + max(1, n // 2)) for n in self.shape)] = 1
        return v

    def add_stage(self, name):
        colours = [f"{n}.rgb" for n, stage in self.stages.items() if stage["op"] == "transfer"]
        op = self.pick(*(o for o in OPS if o != "ambient_light" or colours))
        stage, source, more = {"op": op}, self.pick(*self.names[-5:]), []
        stage |= {"inputs": [source, self.pick(*self.names)]} if op == "combine" else {"input": source}
        if op in ("box", "ambient_occlusion", "gaussian"):
            self.set_border(stage, self.pick("clip", "clip", "nearest", "reflect", "constant"), self.pick(7.0, 0.5, -3.25, 0.0))
        if op in ("box", "ambient_occlusion"):
            self.set_radius(stage)
        if op == "ambient_occlusion":
            stage |= {"method": self.pick(*METHODS, "levels", "moments4"), "ties": self.pick("le", "mid"), "solid": self.pick("high", "low")}
            more = ["lower", "upper"] if stage["method"] == "moments4" else []
            if self.chance(0.3):
                stage["region"] = self.pick("equal_volume", "ball") if stage["method"] == "exact" else "equal_volume"
        elif op == "gaussian":
            self.set_sigma(stage)
        elif op in ("gradient", "saliency"):
            stage |= {"size": self.pick(3, 5), "weight": self.pick("distance", "inverse")}
            stage |= {"scale": self.pick("none", "max")} if op == "saliency" else {}
        elif op == "obscurance":
            more = self.set_sweep(stage, colours)
        elif op == "opacity_modulation":
            stage["by"] = self.pick(*self.names)
            stage |= {"sigma_max2": self.pick(0.3, 50.0)} if self.chance(0.5) else {"threshold": 0.2013, "gain": self.pick(0.5, 2.0)}
        elif op == "ambient_light":
            stage |= {"rgb": self.pick(*colours), "k": self.pick(1.0, 0.7, 2.5)}
        self.set_point(stage)
        if self.chance(0.4):
            self.set_where(stage)
        self.keep_stage(name, stage, *more)

    def set_radius(self, stage):
        unit, length = self.pick(*UNITS), self.pick(0.9, 1.4, 2.1, 1.0)
        near_half = any(abs(length / s % 1 - 0.5) < 1e-9 for s in self.spacing)
        if near_half or not self.chance(0.25):
            stage["radius"] = [self.pick(0, 1, 2, 3, *([40] if "border" not in stage else [])) for _ in range(3)]
        else:
            stage["_toml_radius"] = f"{length * UNITS[unit]!r} {unit}"
            stage["radius"] = [max(math.floor(length / s + 0.5), int(n > 1)) for s, n in zip(self.spacing, self.shape)]

    def set_sigma(self, stage):
        length = self.pick(0.8, 1.1, 1.7)
        if self.chance(0.3):
            stage |= {"_toml_sigma": f"{length} mm", "sigma": [length / s for s in self.spacing]}
        else:
            stage["sigma"] = [self.pick(0.3, 0.7, 1.5, 2.6) for _ in range(3)]

    def set_sweep(self, stage, colours):
        stage |= {"directions": self.pick(12, 42), "rho": self.pick("step", "linear", "exponential", "sqrt"), "solid": self.pick("high", "low"),
                  "max_distance": self.pick(2.0, 5.0, 64.0), "weights": self.pick("uniform", "uniform", "voronoi"), "weight_by_normal": self.chance(0.2)}
        if self.chance(0.2):
            stage |= {"_toml_max_distance": "3.1 mm", "max_distance": 3.1 / min(self.spacing)}
        if not colours or self.chance(0.4):
            return []
        stage |= {"colour": self.pick(*colours), "ambient": self.rng.random(3).round(3).tolist()}
        return ["rgb"]

    def set_where(self, stage):
        """Bounds and isosurfaces of an input or of a channel, at values that it is likely to have."""
        chosen = self.pick(*self.names, *(["m"] * 3 if "m" in self.inputs else []))
        f = self.fields.get(chosen, self.fields["a"])
        found = f.scaled[f.valid]
        low, high = sorted(self.rng.random(2).tolist())
        value_like = chosen in self.fields or chosen.split(".")[-1] in ("mean", "min", "max")
        if chosen == "m":
            where = {"min": 1}
        elif found.size and value_like:
            low, high = (float(np.quantile(found, q)) + 0.0625 for q in (low, high))
        if chosen != "m":
            where = self.pick({"min": low}, {"max": high}, {"min": low, "max": high}, {"iso": low, "band": self.pick(0.5, 1.0, 2.0)},
                              {"iso": sorted({low, high}), "band": self.pick(0.5, 1.0, 2.0)})
        stage["where"] = {"input": chosen} | where
        if self.chance(0.6):
            stage["fill"] = self.pick(0.25, -7.0, 1.0, 300.0)

    def make_pyramids(self):
        pyramids = {}
        for i in range(self.pick(1, 2, 3)):
            channels = [f"{s}.{c}" for s, stage in self.stages.items() for c in stage["_channels"]]
            several = self.chance(0.4) and len(channels) > 1
            plain = [c for c in channels if c.split(".")[1] not in ("rgb", "vector")]
            chosen = self.rng.choice(plain, min(len(plain), self.pick(2, 3)), replace=False).tolist() if several else [self.pick(*channels)]
            if any(self.unsure[c.split(".")[0]].any() or self.fields[c].infinite() for c in chosen):
                continue
            kinds = {c.split(".")[1] for c in chosen}
            known = kinds in ({"variance"}, {"std"}) and all(self.stages[c.split(".")[0]]["op"] in ("box", "gaussian") for c in chosen)
            reduce = self.pick("mean", "stride", *(["moments"] if known else []), *(kinds if kinds in ({"min"}, {"max"}) else []))
            chunk, version = self.pick(2, 4, 8), self.pick("ome-zarr-0.5", "ome-zarr-0.5", "ome-zarr-0.4")
            pyramids[f"z{i}"] = {"path": f"z{i}.zarr", "from": chosen if len(chosen) > 1 else chosen[0], "format": version,
                                 "dtype": "u8" if kinds == {"openness"} and self.chance(0.5) else "native", "reduce": reduce, "chunk": chunk,
                                 "codec": self.pick("blosc-lz4", "zstd:1", "none")}
            if version == "ome-zarr-0.5":
                pyramids[f"z{i}"]["shard"] = self.pick(chunk, 2 * chunk, "none")
        return pyramids

    def settings(self):
        brick = self.pick("auto", 4, [self.pick(1, 2, 3, 5, 8, 32) for _ in range(3)])
        return {"memory": self.pick("64MiB", "128MiB", "1GiB"), "brick": brick, "threads": self.pick(1, 2, 3)}

    def decoded(self, pyramids):
        """Every level's voxels and what viewers read beside them."""
        groups = {name: zarr.open_group(str(self.folder / output["path"]), mode="r") for name, output in pyramids.items()}
        attributes = {name: {k: v for k, v in dict(g.attrs).items() if k != "occlude"} for name, g in groups.items()}
        return attributes, {(name, k): g[k][:].tobytes() for name, g in groups.items() for k in g.array_keys()}

    def judge_all(self):
        outputs = self.judge_channels()
        if outputs is None:
            return
        self.same_again(outputs, self.settings(), *self.pick(["--no-skip"], []))
        pyramids = self.make_pyramids()
        if pyramids and self.run(self.settings(), pyramids, *self.pick(["--no-skip"], [])):
            for name, output in pyramids.items():
                self.judge_pyramid(name, output)
            first = self.decoded(pyramids)
            if self.run(self.settings(), pyramids) and self.decoded(pyramids) != first:
                self.fail("pyramids differ in another run")
        self.same_region(outputs)


if __name__ == "__main__":
    campaign(Graph, 180)
