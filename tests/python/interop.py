#!/usr/bin/env python3
"""Runs the program on files that other programs wrote and compares with the formulas in plain NumPy.

    interop.py PATH_TO_OCCLUDE

Everything here is brute force over small volumes, written from the definitions alone. Exit code 1 on the first fault.
"""

import json
import math
import pathlib
import subprocess
import sys
import tempfile

import further
import numpy as np

PROGRAM = pathlib.Path(sys.argv[1]).resolve()
RNG = np.random.default_rng(5)
CHECKS = 0


def run(folder, text, *flags, code=0):
    (folder / "config.toml").write_text(text)
    done = subprocess.run([PROGRAM, "run", folder / "config.toml", "--overwrite", "-q", *flags], capture_output=True, text=True)
    if done.returncode != code:
        raise SystemExit(f"exit {done.returncode}, expected {code}:\n{text}\n{done.stderr}")
    return done.stderr


def stage(folder, source, body, channel="s", **output):
    """Runs one stage over `source` (TOML of the input) and returns the f32/f64 result as an array."""
    keys = "".join(f"{k} = {json.dumps(v)}\n" for k, v in output.items())
    run(folder, f"[run]\nmemory = '256MiB'\nbrick = 16\n[input.a]\n{source}\n[stage.s]\ninput = 'a'\n{body}\n[output.o]\npath = 'o.npy'\nfrom = '{channel}'\n"
        + (keys or "dtype = 'native'\n"))
    return np.load(folder / "o.npy")


def close(name, got, want, tolerance):
    global CHECKS
    CHECKS += 1
    got, want = np.asarray(got, np.float64), np.asarray(want, np.float64)
    if got.shape != want.shape:
        raise SystemExit(f"{name}: shape {got.shape}, expected {want.shape}")
    if not np.array_equal(np.isnan(got), np.isnan(want)):
        raise SystemExit(f"{name}: NaN in {np.isnan(got).sum()} voxels, expected {np.isnan(want).sum()}")
    error = np.nanmax(np.abs(got - want), initial=0)
    if not error <= tolerance:
        at = np.unravel_index(np.nanargmax(np.abs(got - want)), got.shape)
        raise SystemExit(f"{name}: off by {error} at {at}: {got[at]}, expected {want[at]}")
    print(f"ok {name}: {error:.3g}")


def windows(v, radius, ball=False):
    """For each voxel its centre and the valid voxels of its window."""
    r = np.broadcast_to(radius, 3)
    for i in np.ndindex(v.shape):
        lo = [max(0, i[a] - r[a]) for a in range(3)]
        part = v[tuple(slice(lo[a], i[a] + r[a] + 1) for a in range(3))]
        if ball:
            d = np.indices(part.shape).T + np.array(lo) - np.array(i)
            q = sum(np.where(d[..., a] == 0, 0, (d[..., a] / max(r[a], 1e-9)) ** 2) for a in range(3)).T
            part = part[q <= 1 + 1e-12]
        else:
            part = part.ravel()
        yield i, v[i], part[~np.isnan(part)]


def over(v, radius, f, ball=False):
    out = np.full(v.shape, np.nan)
    for i, c, part in windows(v, radius, ball):
        if not np.isnan(c):
            out[i] = f(c, part)
    return out


def phi(x):
    return 0.5 * math.erfc(-x / math.sqrt(2))


def openness(method, mid):
    def f(c, w):
        if w.min() == w.max():
            return 0.5 if mid else 1.0
        lo, hi, mean = w.min(), w.max(), math.fsum(w) / len(w)
        var = math.fsum((w - mean) ** 2) / len(w)
        if method == "exact":
            le, lt = (w <= c).mean(), (w < c).mean()
            return (le + lt) / 2 if mid else le
        if method == "cdf_power":
            t = (c - lo) / (hi - lo)
            beta = min(max((mean - lo) / (hi - mean), 1e-6), 1e6)
            return t**beta
        if method == "gaussian_cdf":
            return phi((c - mean) / math.sqrt(var))
        p = 1.0 if c <= mean else var / (var + (c - mean) ** 2)
        return 1 - p if method == "chebyshev" else p

    return f


def methods(folder):
    shape = (13, 11, 17)
    volumes = {
        "u8": RNG.integers(0, 256, shape).astype("u1"),
        "i8 blocks": np.repeat(RNG.integers(-128, 128, (13, 11, 2)), 9, axis=2)[:, :, :17].astype("i1"),
        "u16 top": (65535 - RNG.integers(0, 4, shape)).astype("<u2"),
        "i16": RNG.integers(-32768, 32768, shape).astype("<i2"),
        "u32": RNG.integers(0, 2**32, shape).astype("<u4"),
        "i32 near": (2**31 - 1 - RNG.integers(0, 3, shape)).astype("<i4"),
        "f32 offset": (1e6 + RNG.normal(size=shape)).astype("<f4"),
        "f32 step": np.where(np.indices(shape)[2] > 8, 1e6, 0).astype("<f4") + RNG.normal(size=shape).astype("<f4"),
        "f64": RNG.normal(size=shape).astype("<f8"),
        "f32 outlier": np.where(RNG.random(shape) < 0.01, 1e4, RNG.random(shape)).astype("<f4"),
    }
    holes = RNG.normal(size=shape).astype("<f4")
    holes[RNG.random(shape) < 0.2] = np.nan
    volumes["f32 holes"] = holes
    for name, v in volumes.items():
        np.save(folder / "a.npy", v)
        d = v.astype(np.float64)
        source = "path = 'a.npy'"
        for method in ["exact", "cdf_power", "gaussian_cdf", "chebyshev", "chebyshev_literal"]:
            for ties in ["le", "mid"]:
                body = f"op = 'ambient_occlusion'\nmethod = '{method}'\nradius = [2, 1, 3]\nties = '{ties}'"
                want = over(d, (2, 1, 3), openness(method, ties == "mid"))
                close(f"{name} {method} {ties}", stage(folder, source, body), want, 1e-5)
            body = f"op = 'ambient_occlusion'\nmethod = '{method}'\nradius = 2\nsolid = 'low'"
            close(f"{name} {method} low", stage(folder, source, body), over(-d, 2, openness(method, False)), 1e-5)
        box = "op = 'box'\nradius = [2, 1, 3]"
        for channel, f in {
            "mean": lambda c, w: math.fsum(w) / len(w),
            "min": lambda c, w: w.min(),
            "max": lambda c, w: w.max(),
            "variance": lambda c, w: math.fsum((w - math.fsum(w) / len(w)) ** 2) / len(w),
            "std": lambda c, w: math.sqrt(math.fsum((w - math.fsum(w) / len(w)) ** 2) / len(w)),
            "moment2": lambda c, w: math.fsum(w * w) / len(w),
        }.items():
            want = over(d, (2, 1, 3), f)
            got = stage(folder, source, box, f"s.{channel}")
            close(f"{name} {channel}", got / np.nanmax(np.abs(want)), want / np.nanmax(np.abs(want)), 1e-5)
        body = "op = 'ambient_occlusion'\nmethod = 'exact'\nradius = [2, 2, 3]\nregion = 'ball'"
        close(f"{name} ball", stage(folder, source, body), over(d, (2, 2, 3), openness("exact", False), True), 1e-6)


def borders(folder):
    v = RNG.integers(0, 256, (9, 10, 12)).astype("u1")
    np.save(folder / "a.npy", v)
    for border, mode in [("'nearest'", "edge"), ("'reflect'", "symmetric"), ("{ constant = 7.5 }", "constant")]:
        pad = np.pad(v.astype(float), 3, mode=mode, **({"constant_values": 7.5} if mode == "constant" else {}))
        for method in ["exact", "cdf_power", "gaussian_cdf"]:
            want = over(pad, 3, openness(method, False))[3:-3, 3:-3, 3:-3]
            body = f"op = 'ambient_occlusion'\nmethod = '{method}'\nradius = 3\nborder = {border}"
            close(f"border {border} {method}", stage(folder, "path = 'a.npy'", body), want, 1e-5)
    want = over(v.astype(float), 40, openness("cdf_power", False))
    body = "op = 'ambient_occlusion'\nmethod = 'cdf_power'\nradius = 40"
    close("radius beyond the volume", stage(folder, "path = 'a.npy'", body), want, 1e-5)
    side = round((0.806 * 7 - 1) / 2)
    want = over(v.astype(float), side, openness("chebyshev", False))
    body = "op = 'ambient_occlusion'\nmethod = 'chebyshev'\nradius = 3\nregion = 'equal_volume'"
    close("equal volume", stage(folder, "path = 'a.npy'", body), want, 1e-5)


def gaussians(folder):
    v = RNG.normal(size=(12, 9, 20)).astype("<f4") + 1000
    np.save(folder / "a.npy", v)
    sigma = (1.0, 0.5, 2.0)
    d = v.astype(float)

    def blur(x):
        for a, s in enumerate(sigma):
            r = math.ceil(3 * s)
            k = np.exp(-0.5 * (np.arange(-r, r + 1) / s) ** 2)
            out = np.zeros_like(x)
            for i in range(x.shape[a]):
                lo, hi = max(0, i - r), min(x.shape[a], i + r + 1)
                w = k[lo - i + r : hi - i + r]
                np.moveaxis(out, a, 0)[i] = np.tensordot(w / w.sum(), np.moveaxis(x, a, 0)[lo:hi], 1)
            x = out
        return x

    mean, second = blur(d - 1000), blur((d - 1000) ** 2)
    body = "op = 'gaussian'\nsigma = [1.0, 0.5, 2.0]"
    close("gaussian mean", stage(folder, "path = 'a.npy'", body), mean + 1000, 1e-3)
    close("gaussian variance", stage(folder, "path = 'a.npy'", body, "s.variance"), second - mean**2, 1e-5)


def gradients(folder):
    v = RNG.normal(size=(8, 9, 10)).astype("<f4")
    np.save(folder / "a.npy", v)
    spacing = np.array([2.0, 1.0, 0.5])
    for size in (3, 5):
        for weight in ("distance", "inverse"):
            h = size // 2
            pad = np.pad(v.astype(float), h, mode="edge")
            offsets = [np.array(o) - h for o in np.ndindex(size, size, size)]
            comps = []
            for a in range(3):
                num, den = np.zeros(v.shape), 0.0
                for o in offsets:
                    dist = np.linalg.norm(o * spacing)
                    if dist == 0:
                        continue
                    w = dist if weight == "distance" else 1 / dist
                    part = pad[tuple(slice(h + o[b], h + o[b] + v.shape[b]) for b in range(3))]
                    num += w * part * o[a] * spacing[a]
                    den += w * (o[a] * spacing[a]) ** 2
                comps.append(num / den)
            source = "path = 'a.npy'\nspacing = [2.0, 1.0, 0.5]"
            body = f"op = 'gradient'\nsize = {size}\nweight = '{weight}'"
            close(f"gradient {size} {weight}", stage(folder, source, body), np.sqrt(sum(c * c for c in comps)), 1e-5)
            close(f"gradient vector {size} {weight}", stage(folder, source, body, "s.vector"), np.array(comps), 1e-5)


def icosahedron(n):
    g = (1 + math.sqrt(5)) / 2
    base = [(0, a, b * g) for a in (1, -1) for b in (1, -1)]
    points = [np.roll(p, k) for p in base for k in range(3)]
    points = [p / np.linalg.norm(p) for p in points]
    while len(points) < n:
        best = min(np.linalg.norm(p - q) for i, p in enumerate(points) for q in points[:i])
        if len(points) == 12:
            edges = [(p, q) for i, p in enumerate(points) for q in points[:i] if np.linalg.norm(p - q) < best * 1.01]
        else:  # the 42 points have two edge lengths; faces of the subdivided icosahedron
            edges = [(p, q) for i, p in enumerate(points) for q in points[:i] if np.linalg.norm(p - q) < best * 1.3]
        points += [(p + q) / np.linalg.norm(p + q) for p, q in edges]
    assert len(points) == n, len(points)
    return points


def fibonacci(n):
    half = n // 2 if n % 2 == 0 else n
    points = []
    for i in range(half):
        z = 1 - (2 * i + 1) / n
        azimuth = 2 * math.pi * i * (math.sqrt(5) - 1) / 2
        s = math.sqrt(1 - z * z)
        points.append(np.array([s * math.cos(azimuth), s * math.sin(azimuth), z]))
    return points + ([-p for p in points] if n % 2 == 0 else [])


def rho_of(name, d, dmax):
    return {"step": 0.0, "linear": d / dmax, "exponential": 1 - math.exp(-d / dmax), "sqrt": math.sqrt(d / dmax)}[name]


def sweep(v, directions, rho, dmax, spacing, colour=None, ambient=(1, 1, 1)):
    out = np.zeros(v.shape)
    rgb = np.zeros((3,) + v.shape)
    fine = min(spacing)
    for w in directions:
        u = np.array([w[2], w[1], w[0]]) / spacing
        a = max(range(3), key=lambda i: (round(abs(u[i]), 12), -i))
        sign = 1 if u[a] > 0 else -1
        m = u / abs(u[a])
        d1 = np.linalg.norm(np.array(spacing) * m) / fine
        reach = math.floor(dmax / d1 + 1e-9)
        shift = lambda k, b: math.floor(k * m[b] + 0.5)
        for p in np.ndindex(v.shape):
            if np.isnan(v[p]):
                continue
            value, hit = 1.0, None
            for j in range(1, reach + 1):
                q = list(p)
                q[a] = p[a] + sign * j
                k = sign * p[a]
                for b in range(3):
                    if b != a:
                        q[b] = p[b] + shift(k + j, b) - shift(k, b)
                if any(q[b] < 0 or q[b] >= v.shape[b] for b in range(3)):
                    break
                if v[tuple(q)] > v[p]:
                    value, hit = rho_of(rho, j * d1, dmax), tuple(q)
                    break
            out[p] += value / len(directions)
            for c in range(3):
                rgb[(c,) + p] += (ambient[c] if hit is None else value * colour[(c,) + hit] if colour is not None else 0) / len(directions)
    out[np.isnan(v)] = np.nan
    return out, rgb


def obscurances(folder):
    shape = (8, 9, 7)
    volumes = {
        "u8": RNG.integers(0, 40, shape).astype("u1"),
        "i16": RNG.integers(-300, 300, shape).astype("<i2"),
        "f32": RNG.normal(size=shape).astype("<f4"),
        "f64": RNG.normal(size=shape).astype("<f8"),
    }
    volumes["f32"][RNG.random(shape) < 0.1] = np.nan
    for name, v in volumes.items():
        np.save(folder / "a.npy", v)
        for spacing, rho, count, kind, dmax in [
            ([1.0, 1.0, 1.0], "sqrt", 42, "icosahedron", 64),
            ([2.0, 1.0, 1.5], "linear", 12, "icosahedron", 5),
            ([1.0, 0.7, 1.0], "exponential", 10, "fibonacci", 4.5),
            ([1.0, 1.0, 1.0], "step", 7, "fibonacci", 3),
            ([1.0, 1.0, 1.0], "sqrt", 162, "icosahedron", 6),
        ]:
            points = icosahedron(count) if kind == "icosahedron" else fibonacci(count)
            if count == 162 and name != "u8":
                continue
            want, _ = sweep(v.astype(float), points, rho, dmax, spacing)
            body = f"op = 'obscurance'\ndirections = {count}\nset = '{kind}'\nrho = '{rho}'\nmax_distance = {dmax}"
            got = stage(folder, f"path = 'a.npy'\nspacing = {spacing}", body)
            close(f"obscurance {name} {rho} {count} {kind}", got, want, 2e-6)
    v = RNG.integers(0, 4, (7, 6, 8)).astype("u1")
    np.save(folder / "a.npy", v)
    table = {0: (0.1, 0.2, 0.3), 1: (1, 0, 0), 2: (0, 1, 0), 3: (0, 0, 1)}
    colour = np.array([[table[int(x)][c] for x in v.ravel()] for c in range(3)]).reshape((3,) + v.shape)
    points = ", ".join(f"[{k}, {k / 3}, {r}, {g}, {b}]" for k, (r, g, b) in table.items())
    _, want = sweep(v.astype(float), icosahedron(42), "sqrt", 5, [1.0] * 3, colour, (0.5, 1, 1))
    run(folder, f"""
[input.a]
path = 'a.npy'
[stage.t]
op = 'transfer'
input = 'a'
points = [{points}]
[stage.s]
op = 'obscurance'
input = 't.opacity'
colour = 't.rgb'
max_distance = 5
ambient = [0.5, 1, 1]
[output.o]
path = 'o.npy'
from = 's.rgb'
""")
    close("colour bleeding", np.load(folder / "o.npy"), want, 2e-5)


def formats(folder):
    import nibabel
    import nrrd
    import SimpleITK
    import tifffile
    import zarr

    v = RNG.integers(-1000, 1000, (9, 10, 11)).astype("<i2")
    image = nibabel.Nifti1Image(v.T, np.diag([0.5, 0.75, 2, 1]))
    image.header.set_xyzt_units("mm")
    for name in ["a.nii", "a.nii.gz"]:
        nibabel.save(image, folder / name)
        close(name, plain(folder, f"path = '{name}'"), v, 0)
    scaled = nibabel.Nifti1Image(v.T, np.eye(4))
    scaled.header.set_slope_inter(0.5, 10)
    nibabel.save(scaled, folder / "s.nii")
    raw = np.asanyarray(nibabel.load(folder / "s.nii").dataobj)
    close("NIfTI slope", plain(folder, "path = 's.nii'"), raw.T, 1e-3)
    for encoding in ["raw", "gzip"]:
        nrrd.write(str(folder / "a.nrrd"), v.T, {"encoding": encoding, "spacings": [0.5, 0.75, 2]})
        close(f"NRRD {encoding}", plain(folder, "path = 'a.nrrd'"), v, 0)
    nrrd.write(str(folder / "a.nhdr"), v.T, {"encoding": "raw"})
    close("NHDR", plain(folder, "path = 'a.nhdr'"), v, 0)
    for name, compress in [("a.mha", False), ("b.mha", True), ("c.mhd", False), ("d.mhd", True)]:
        itk = SimpleITK.GetImageFromArray(v)
        itk.SetSpacing((0.5, 0.75, 2))
        SimpleITK.WriteImage(itk, str(folder / name), compress)
        close(name, plain(folder, f"path = '{name}'"), v, 0)
    u = (v + 1000).astype("u2")
    for name, keys in [("a.tif", {}), ("b.tif", {"compression": "zlib"}), ("c.tif", {"bigtiff": True}), ("d.tif", {"byteorder": ">"}),
                       ("e.tif", {"tile": (16, 16)}), ("f.tif", {"imagej": True, "metadata": {"axes": "ZYX", "spacing": 2.0, "unit": "um"}})]:
        tifffile.imwrite(folder / name, u, photometric="minisblack", **keys)
        close(f"TIFF {name}", plain(folder, f"path = '{name}'"), u, 0)
    (folder / "slices").mkdir()
    for z in range(9):
        tifffile.imwrite(folder / "slices" / f"s{z + 5}.tif", u[z])
    close("TIFF folder", plain(folder, "path = 'slices'"), u, 0)
    for version in (2, 3):
        z = zarr.create_array(store=str(folder / f"z{version}"), shape=v.shape, chunks=(4, 4, 4), dtype="i2", zarr_format=version, fill_value=7)
        z[:5] = v[:5]
        want = np.full(v.shape, 7)
        want[:5] = v[:5]
        close(f"Zarr v{version}", plain(folder, f"path = 'z{version}'"), want, 0)
    fortran = {"zarr_format": 2, "order": "F"}
    turned = {"zarr_format": 3, "filters": [zarr.codecs.TransposeCodec(order=(1, 2, 0))]}
    for name, keys in [("zf", fortran), ("zt", turned)]:
        z = zarr.create_array(store=str(folder / name), shape=v.shape, chunks=(4, 5, 6), dtype="i2", **keys)
        z[:] = v
        close(f"Zarr {name}", plain(folder, f"path = '{name}'"), v, 0)
    z = zarr.create_array(store=str(folder / "zs"), shape=v.shape, chunks=(4, 4, 4), shards=(8, 8, 8), dtype="i2", zarr_format=3)
    z[:] = v
    close("Zarr sharded", plain(folder, "path = 'zs'"), v, 0)
    (folder / "a.raw").write_bytes(b"head" + v.astype(">i2").tobytes())
    close("raw", plain(folder, "path = 'a.raw'\nformat = 'raw'\nshape = [9, 10, 11]\ndtype = 'i16'\nendian = 'big'\noffset = 4"), v, 0)
    np.save(folder / "a.npy", v)
    outputs = {"n": "o.nrrd", "i": "o.nii", "r": "o.raw"}
    run(folder, "[input.a]\npath = 'a.nii'\n" + "".join(f"[output.{k}]\npath = '{p}'\nfrom = 'a'\n" for k, p in outputs.items()))
    data, header = nrrd.read(str(folder / "o.nrrd"))
    close("NRRD out", data.T, v, 0)
    back = nibabel.load(folder / "o.nii")
    close("NIfTI out", np.asanyarray(back.dataobj).T, v, 0)
    close("NIfTI affine", back.affine, image.affine, 1e-6)
    close("raw out", np.fromfile(folder / "o.raw", "<i2").reshape(v.shape), v, 0)


def pyramids(folder):
    import tensorstore
    import zarr

    v = RNG.integers(0, 256, (41, 30, 53)).astype("u1")
    np.save(folder / "a.npy", v)
    for version in ("ome-zarr-0.5", "ome-zarr-0.4"):
        run(folder, f"""
[run]
brick = 16
[input.a]
path = 'a.npy'
spacing = [2.0, 1.0, 1.0]
unit = 'micrometer'
origin = [5.0, 0.0, 0.0]
[stage.s]
op = 'box'
input = 'a'
radius = 1
[output.o]
path = 'o.zarr'
from = 'a'
format = '{version}'
chunk = 8
shard = 16
[output.v]
path = 'v.zarr'
from = 's.variance'
reduce = 'moments'
chunk = 8
shard = 16
""")
        group = zarr.open_group(str(folder / "o.zarr"), mode="r")
        attrs = dict(group.attrs)
        image = (attrs["ome"] if version.endswith("5") else attrs)["multiscales"][0]
        assert attrs["occlude"]["complete"] is True
        # z is halved only once y and x have caught up.
        factor, n, d = np.array([1, 1, 1]), np.array(v.shape), v.astype(float)
        for k, dataset in enumerate(image["datasets"]):
            a = group[dataset["path"]][:]
            want = np.empty(n)
            for i in np.ndindex(*n):
                cell = d[tuple(slice(i[b] * factor[b], (i[b] + 1) * factor[b]) for b in range(3))]
                want[i] = np.round(cell.mean())
            close(f"{version} level {k}", a, want, 0)
            scale, translation = [t[t["type"]] for t in dataset["coordinateTransformations"]]
            spacing = np.array([2.0, 1.0, 1.0])
            close(f"{version} scale {k}", scale, spacing * factor, 0)
            close(f"{version} translation {k}", translation, np.array([5.0, 0, 0]) + spacing * (factor - 1) / 2, 0)
            driver = "zarr3" if version.endswith("5") else "zarr"
            other = tensorstore.open({"driver": driver, "kvstore": {"driver": "file", "path": str(folder / "o.zarr" / dataset["path"])}}).result()
            close(f"{version} TensorStore {k}", other.read().result(), a, 0)
            now = spacing * factor
            halve = [n[b] > 1 and now[b] < 2 * min(now[c] for c in range(3) if n[c] > 1) * (1 - 1e-9) for b in range(3)]
            n = np.array([(n[b] + 1) // 2 if halve[b] else n[b] for b in range(3)])
            factor = np.array([factor[b] * 2 if halve[b] else factor[b] for b in range(3)])
        try:
            import ome_zarr_models

            ome_zarr_models.open_ome_zarr(group)
        except ImportError:
            print("skipped: ome-zarr-models is not installed")
    mean = over(v.astype(float), 1, lambda c, w: w.mean())
    var = over(v.astype(float), 1, lambda c, w: w.var())
    group = zarr.open_group(str(folder / "v.zarr"), mode="r")
    a = group["1"][:]
    want = np.empty(a.shape)
    for i in np.ndindex(*a.shape):
        f = [1 if a.shape[b] == v.shape[b] else 2 for b in range(3)]
        cell = tuple(slice(i[b] * f[b], (i[b] + 1) * f[b]) for b in range(3))
        want[i] = var[cell].mean() + mean[cell].var()
    close("pooled variance level 1", a, want, 1e-2)


def maps(folder):
    import zarr

    v = RNG.normal(size=(21, 16, 33)).astype("<f4")
    np.save(folder / "a.npy", v)
    taps = np.array([1, 4, 6, 4, 1]) / 16

    def blur(x):
        for a in range(3):
            out = np.zeros_like(x)
            y = np.moveaxis(x, a, 0)
            o = np.moveaxis(out, a, 0)
            for i in range(len(y)):
                lo, hi = max(0, i - 2), min(len(y), i + 3)
                w = taps[lo - i + 2 : hi - i + 2]
                o[i] = np.tensordot(w / w.sum(), y[lo:hi], 1)
            x = out
        return x

    def halve(x):
        for a in range(3):
            y = np.moveaxis(x, a, 0)
            y = np.array([y[2 * i : 2 * i + 2].mean(axis=0) for i in range((len(y) + 1) // 2)])
            x = np.moveaxis(y, 0, a)
        return x

    for start in (0, 1):
        run(folder, f"""
[run]
brick = 8
[input.a]
path = 'a.npy'
[stage.s]
op = 'occlusion_map'
input = 'a'
start_level = {start}
[output.o]
path = 'o.zarr'
from = ['s.mean', 's.variance']
chunk = 4
shard = 8
""")
        group = zarr.open_group(str(folder / "o.zarr"), mode="r")
        datasets = dict(group.attrs)["ome"]["multiscales"][0]["datasets"]
        m1, m2 = v.astype(float), v.astype(float) ** 2
        for k in range(start + len(datasets)):
            if k > 0:
                m1, m2 = halve(blur(m1)), halve(blur(m2))
            if k >= start:
                a = group[str(k - start)][:]
                close(f"occlusion map {start} level {k} mean", a[0], m1, 1e-5)
                close(f"occlusion map {start} level {k} variance", a[1], m2 - m1**2, 1e-5)
                scale = datasets[k - start]["coordinateTransformations"][-2]["scale"]
                close(f"occlusion map {start} level {k} scale", scale[-3:], [2.0**k] * 3, 0)


def scaling(folder):
    """Slope, intercept, nodata, physical radii, thresholds in scaled units."""
    v = RNG.integers(-100, 100, (9, 8, 12)).astype("<i2")
    v[RNG.random(v.shape) < 0.1] = -1000
    np.save(folder / "a.npy", v)
    d = v.astype(float)
    d[v == -1000] = np.nan
    for slope, intercept in [(2.0, -5.0), (-0.5, 3.0)]:
        source = f"path = 'a.npy'\nslope = {slope}\nintercept = {intercept}\nnodata = -1000\nspacing = [2.0, 1.0, 1.0]\nunit = 'mm'"
        w = slope * d + intercept
        r = (1, 2, 2)
        box = "op = 'box'\nradius = '2.1 mm'"
        for channel, f in {"mean": np.mean, "min": np.min, "max": np.max, "variance": np.var, "std": np.std, "moment2": lambda x: np.mean(x * x)}.items():
            want = over(w, r, lambda c, x: f(x))
            got = stage(folder, source, box, f"s.{channel}")
            assert got.dtype == np.float32, (channel, got.dtype)
            close(f"slope {slope} {channel}", got, want, 1e-5 * np.nanmax(np.abs(want)))
        for method in ["exact", "cdf_power", "gaussian_cdf", "chebyshev"]:
            body = f"op = 'ambient_occlusion'\nmethod = '{method}'\nradius = '2.1 mm'"
            close(f"slope {slope} {method}", stage(folder, source, body), over(w, r, openness(method, False)), 1e-5)
        close(f"slope {slope} input", plain(folder, source), w, 1e-4)
    # Without scaling, min and max keep the type; missing voxels hold the fill.
    got = stage(folder, "path = 'a.npy'\nnodata = -1000", "op = 'box'\nradius = 1\nfill = 0", "s.max")
    assert got.dtype == np.int16, got.dtype
    want = over(d, 1, lambda c, x: x.max())
    close("max keeps the type", got[v != -1000], want[v != -1000], 0)
    u8 = stage(folder, "path = 'a.npy'\nnodata = -1000", "op = 'ambient_occlusion'\nmethod = 'exact'\nradius = 1\nfill = 0.2", dtype="u8")
    codes = over(d, 1, openness("exact", False)) * 255
    codes[np.isnan(codes)] = 51
    # O is rounded to f32 before it is scaled, so an exact half may fall either way.
    sure = np.abs(codes % 1 - 0.5) > 1e-4
    close("u8 openness with fill", u8[sure], np.round(codes)[sure], 0)


def plain(folder, source):
    run(folder, f"[input.a]\n{source}\n[output.o]\npath = 'o.npy'\nfrom = 'a'\n")
    return np.load(folder / "o.npy")


def infinities(folder):
    v = RNG.normal(size=(8, 8, 20)).astype("<f4")
    v[4, 4, 3], v[3, 3, 14] = np.inf, -np.inf
    np.save(folder / "a.npy", v)
    d = v.astype(float)
    near = np.zeros(v.shape, bool)
    for z, y, x in [(4, 4, 3), (3, 3, 14)]:
        near[z - 2 : z + 3, y - 2 : y + 3, x - 2 : x + 3] = True
    with np.errstate(all="ignore"):
        mean = over(d, 2, lambda c, w: w.mean())
    got = stage(folder, "path = 'a.npy'", "op = 'box'\nradius = 2")
    close("mean with infinities", np.nan_to_num(got, posinf=1e9, neginf=-1e9), np.nan_to_num(mean, posinf=1e9, neginf=-1e9), 1e-5)
    got = stage(folder, "path = 'a.npy'", "op = 'box'\nradius = 2", "s.variance")
    assert np.isnan(got[near]).all() and not np.isnan(got[~near]).any()
    for method in ["exact", "cdf_power", "gaussian_cdf", "chebyshev"]:
        got = stage(folder, "path = 'a.npy'", f"op = 'ambient_occlusion'\nmethod = '{method}'\nradius = 2")
        assert got[4, 4, 3] == 1 and got[3, 3, 14] == 0, method
        far = np.where(near, 0.0, d)
        want = over(d, 2, lambda c, w: openness(method, False)(c, w) if np.isfinite(w).all() else 0.0)
        close(f"{method} away from infinities", got[~near], want[~near], 1e-5)
        assert far is not None and not np.isnan(got[near & np.isfinite(d)]).any(), method


def pointwise(folder):
    v = RNG.random((10, 9, 11)).astype("<f4") * 100
    np.save(folder / "a.npy", v)
    d = v.astype(float)
    points = [[10, 0.0, 1, 0, 0], [40, 0.5, 0, 1, 0], [80, 1.0, 0.2, 0.4, 0.8]]
    body = f"op = 'transfer'\npoints = {points}"
    xs = [p[0] for p in points]
    close("transfer opacity", stage(folder, "path = 'a.npy'", body), np.interp(d, xs, [p[1] for p in points]), 1e-6)
    rgb = np.array([np.interp(d, xs, [p[c] for p in points]) for c in (2, 3, 4)])
    close("transfer rgb", stage(folder, "path = 'a.npy'", body, "s.rgb"), rgb, 1e-6)
    o = over(d, 2, openness("cdf_power", False))
    var = over(d, 1, lambda c, w: w.var())
    run(folder, f"""
[run]
brick = 8
[input.a]
path = 'a.npy'
spacing = [1, 1, 2]
[stage.ao]
op = 'ambient_occlusion'
input = 'a'
method = 'cdf_power'
radius = 2
[stage.st]
op = 'box'
input = 'a'
radius = 1
[stage.t]
op = 'transfer'
input = 'a'
points = {points}
[stage.keep]
op = 'window'
input = 'ao'
low = 0.3
high = 0.7
[stage.stretch]
op = 'window'
input = 'ao'
low = 0.3
high = 0.7
mode = 'stretch'
[stage.mod]
op = 'opacity_modulation'
input = 't.opacity'
by = 'st.variance'
sigma_max2 = 900
[stage.sal]
op = 'saliency'
input = 'ao'
[stage.max]
op = 'saliency'
input = 'ao'
scale = 'max'
[stage.smod]
op = 'opacity_modulation'
input = 't.opacity'
by = 'max'
threshold = 0.2
gain = 2
[stage.light]
op = 'ambient_light'
input = 'ao'
rgb = 't.rgb'
k = 0.8
[stage.sum]
op = 'combine'
inputs = ['ao', 't.opacity', 'keep']
op_kind = 'add'
""" + "".join(f"[output.{k}]\npath = '{k}.npy'\nfrom = '{k}'\ndtype = 'f32'\n" for k in "keep stretch mod sal max smod light sum".split()))
    get = lambda k: np.load(folder / f"{k}.npy").astype(float)
    keep = np.where(o < 0.3, 0, np.where(o > 0.7, 1, o))
    edge = np.minimum(np.abs(o - 0.3), np.abs(o - 0.7)) > 1e-5
    close("window keep", get("keep")[edge], keep[edge], 1e-5)
    close("window stretch", get("stretch"), np.clip((o - 0.3) / 0.4, 0, 1), 1e-4)
    opacity = np.interp(d, xs, [p[1] for p in points])
    close("modulation by variance", get("mod"), opacity * np.minimum(var / 900, 1), 1e-5)
    close("ambient light", get("light"), 0.8 * o * rgb, 1e-5)
    close("combine", get("sum")[edge], (o + opacity + keep)[edge], 3e-5)
    pad = np.pad(o, 2, mode="edge")
    grad = []
    for a in range(3):
        num, den = np.zeros(o.shape), 0.0
        for i in np.ndindex(5, 5, 5):
            p = (np.array(i) - 2) * np.array([1, 1, 2.0])
            w = np.linalg.norm(p)
            num += w * p[a] * pad[i[0] : i[0] + o.shape[0], i[1] : i[1] + o.shape[1], i[2] : i[2] + o.shape[2]]
            den += w * p[a] ** 2
        grad.append(num / den)
    sal = np.sqrt(sum(g * g for g in grad))
    close("saliency", get("sal"), sal, 1e-5)
    close("saliency over its maximum", get("max"), sal / sal.max(), 1e-4)
    s = sal / sal.max()
    safe = np.abs(s - 0.2) > 1e-4
    close("modulation by saliency", get("smod")[safe], np.clip(np.where(s < 0.2, 0, opacity * s * 2), 0, 1)[safe], 1e-4)


def wheres(folder):
    """Masks, fills, and what they do to levels."""
    import zarr

    v = RNG.normal(size=(20, 18, 22)).astype("<f4")
    v = sum(np.roll(v, k, a) for k in (-1, 0, 1) for a in range(3)).astype("<f4")
    np.save(folder / "a.npy", v)
    d = v.astype(float)
    want = over(d, 1, openness("gaussian_cdf", False))
    for flags in ([], ["--no-skip"]):
        run(folder, """
[run]
brick = 8
[input.a]
path = 'a.npy'
[stage.s]
op = 'ambient_occlusion'
input = 'a'
method = 'gaussian_cdf'
radius = 1
fill = 0.25
where = { input = 'a', min = 0.5, max = 2.5 }
[output.o]
path = 'o.zarr'
from = 's'
dtype = 'f32'
chunk = 8
shard = 16
""", *flags)
        need = (d >= 0.5) & (d <= 2.5)
        group = zarr.open_group(str(folder / "o.zarr"), mode="r")
        full = np.where(need, want, 0.25)
        close(f"where range {flags}", group["0"][:], full, 1e-5)
        one = group["1"][:]
        expect = np.empty(one.shape)
        for i in np.ndindex(*one.shape):
            cell = tuple(slice(2 * k, 2 * k + 2) for k in i)
            expect[i] = want[cell][need[cell]].mean() if need[cell].any() else 0.25
        close(f"where level 1 {flags}", one, expect, 1e-5)
    spacing = np.array([2.0, 1.0, 1.0])
    iso, band = 1.0, 1.5
    crossings = []
    for a in range(3):
        lo = np.moveaxis(d, a, 0)
        for i in range(d.shape[a] - 1):
            f, g = lo[i], lo[i + 1]
            for y, x in np.argwhere(((f < iso) & (iso <= g)) | ((g < iso) & (iso <= f))):
                t = (iso - f[y, x]) / (g[y, x] - f[y, x])
                p = [y, x]
                p.insert(a, i + t)
                crossings.append(np.array(p) * spacing)
    crossings = np.array(crossings)
    need = np.empty(d.shape, bool)
    sure = np.empty(d.shape, bool)
    for i in np.ndindex(d.shape):
        dist = np.sqrt(((crossings - np.array(i) * spacing) ** 2).sum(1)).min()
        need[i], sure[i] = dist <= band, abs(dist - band) > 1e-5
    got = stage(folder, "path = 'a.npy'\nspacing = [2.0, 1.0, 1.0]",
                f"op = 'box'\nradius = 1\nfill = -9\nwhere = {{ input = 'a', iso = [{iso}], band = {band} }}")
    mean = over(d, 1, lambda c, w: w.mean())
    close("where iso", got[sure], np.where(need, mean, -9)[sure], 1e-5)


def ranges(folder):
    """Integer outputs by range, lists of channels, regions, placement."""
    import zarr

    v = RNG.random((14, 15, 16)).astype("<f4") * 10 - 3
    np.save(folder / "a.npy", v)
    d = v.astype(float)
    mean = over(d, 1, lambda c, w: w.mean())
    for dtype, top in [("u8", 255), ("u16", 65535)]:
        got = stage(folder, "path = 'a.npy'", "op = 'box'\nradius = 1", dtype=dtype, range=[0, 3])
        close(f"range {dtype}", got, np.round(np.clip((mean.astype("f4").astype(float)) / 3, 0, 1) * top), 1 if dtype == "u16" else 1)
        got = stage(folder, "path = 'a.npy'", "op = 'box'\nradius = 1", dtype=dtype, range="auto")
        lo, hi = mean.min(), mean.max()
        close(f"range auto {dtype}", got, np.round((mean - lo) / (hi - lo) * top), 1)
    run(folder, """
[run]
region = [[2, 11], [0, 15], [5, 16]]
[input.a]
path = 'a.npy'
spacing = [0.5, 0.25, 0.25]
unit = 'mm'
origin = [1, 2, 3]
[stage.s]
op = 'box'
input = 'a'
radius = 1
[output.o]
path = 'o.zarr'
from = ['s.mean', 's.max']
chunk = 4
shard = 8
""")
    group = zarr.open_group(str(folder / "o.zarr"), mode="r")
    a = group["0"][:]
    high = over(d, 1, lambda c, w: w.max())
    close("region, list", a, np.array([mean, high])[:, 2:11, 0:15, 5:16], 1e-5)
    image = dict(group.attrs)["ome"]["multiscales"][0]
    assert [x["name"] for x in image["axes"]] == ["c", "z", "y", "x"] and image["axes"][1]["unit"] == "millimeter"
    scale, move = image["datasets"][0]["coordinateTransformations"]
    close("region scale", scale["scale"], [1, 0.5, 0.25, 0.25], 0)
    close("region translation", move["translation"], [0, 2.0, 2.0, 4.25], 1e-12)
    assert "omero" in dict(group.attrs)["ome"]


def commands(folder):
    """Exit codes and JSON of the commands."""
    v = RNG.integers(0, 255, (16, 16, 16)).astype("u1")
    np.save(folder / "a.npy", v)
    text = "[input.a]\npath = 'a.npy'\n[stage.s]\nop = 'box'\ninput = 'a'\nradius = 2\n[output.o]\npath = 'o.zarr'\nfrom = 's'\n"
    (folder / "c.toml").write_text(text)
    call = lambda *args: subprocess.run([PROGRAM, *map(str, args)], capture_output=True, text=True, cwd=folder)
    plan = call("plan", "c.toml", "--json")
    assert plan.returncode == 0 and json.loads(plan.stdout)["peak_memory_bytes"] > 0
    done = call("run", "c.toml", "--report", "r.json")
    assert done.returncode == 0 and done.stdout == "", done
    report = json.loads((folder / "r.json").read_text())
    for key in "seconds voxels voxels_per_second bricks bytes_read bytes_written read_amplification memory_budget_bytes peak_memory_bytes stages waits placement".split():
        assert key in report, key
    assert call("run", "c.toml").returncode == 2
    assert call("run", "c.toml", "--resume").returncode == 0
    assert call("run", "c.toml", "--overwrite", "--set", "stage.s.radius=1").returncode == 0
    assert call("run", "c.toml", "--resume").returncode == 2
    assert call("run", "missing.toml").returncode == 2
    assert call("run", "c.toml", "--overwrite", "--set", "input.a.path=none.npy").returncode == 1
    bad = call("run", "c.toml", "--overwrite", "--set", "stage.s.radious=1")
    assert bad.returncode == 2 and "radius" in bad.stderr and "panicked" not in bad.stderr, bad.stderr
    assert call("run", "c.toml", "--device", "gpu", "--overwrite").returncode in (0, 1)
    assert call("frobnicate").returncode == 2
    info = json.loads(call("info", "o.zarr", "--json", "--stats").stdout)
    assert info["shape"] == [16, 16, 16], info
    same = call("compare", "a.npy", "a.npy", "--json")
    assert same.returncode == 0 and json.loads(same.stdout)["rmse"] == 0, same
    assert call("compare", "a.npy", "o.zarr", "--max-rmse", "0.001").returncode == 1
    assert call("preview", "o.zarr", "p.png").returncode == 0 and (folder / "p.png").read_bytes()[:4] == b"\x89PNG"
    schema = call("schema")
    assert json.loads(schema.stdout)["type"] == "object"
    assert "occlude" in call("completions", "bash").stdout
    (folder / "junk.zarr").mkdir()
    (folder / "junk.zarr" / "mine.txt").write_text("precious")
    foreign = call("run", "c.toml", "--overwrite", "--set", "output.o.path=junk.zarr")
    assert foreign.returncode == 2 and (folder / "junk.zarr" / "mine.txt").exists()
    global CHECKS
    CHECKS += 20


def second_reading(folder):
    further.run_all(folder, stage, close)


def main():
    parts = [methods, borders, gaussians, gradients, obscurances, formats, pyramids, maps, scaling, infinities, pointwise, wheres, ranges, commands, second_reading]
    chosen = sys.argv[2:]
    for part in parts:
        if chosen and part.__name__ not in chosen:
            continue
        with tempfile.TemporaryDirectory() as folder:
            part(pathlib.Path(folder))
    print(f"{CHECKS} passed, 0 failed")


main()
