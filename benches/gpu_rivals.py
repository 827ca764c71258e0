#!/usr/bin/env python3
"""CuPy's uniform, minimum, maximum and Gaussian filters and gradients and torch's pooling on a GPU, beside `cargo bench
--bench gpu`.

    pip install numpy scipy cupy-cuda12x torch
    cargo bench --bench gpu     # runs this script at its end
    python3 benches/gpu_rivals.py [windows] [smooth] [torch] [uint8] ...    # parts: compiling CuPy's windows takes minutes

The same extents, radii and types as the bench, noise, medians of ten after a warm-up, by events of the device; copies to
and from the device are timed apart. CuPy with mode "nearest" and its default "reflect". torch pools floats only, pads with
nothing for max (-inf) and counts existing voxels for the mean, as occlude does. CuPy has no gradient by regression: the
nearest are the gradient magnitude of a Gaussian (its derivatives, where occlude takes the regression of the mean) and
Sobel's, whose window has 3 voxels. Every result is compared with SciPy on a
small volume first; one that differs is said so beside its time. Without a GPU the script says what is missing, and exits
with 3.
"""

import statistics
import sys

SIZE, ROUNDS = 256, 10
TYPES = ["uint8", "uint16", "float32"]


def skip(why):
    print(f"SKIPPED, nothing measured: {why}", file=sys.stderr)
    sys.exit(3)


def cupy_or_skip():
    try:
        import cupy
        import cupyx.scipy.ndimage as filters
    except ImportError as e:
        skip(f"CuPy is not there ({e})")
    try:
        count = cupy.cuda.runtime.getDeviceCount()
    except cupy.cuda.runtime.CUDARuntimeError as e:
        skip(f"no CUDA device ({e})")
    if count == 0:
        skip("no CUDA device")
    return cupy, filters


def timed(cupy, call):
    """Median milliseconds on the device, whose clock goes up with work."""
    import time

    call()
    end = time.perf_counter() + 0.1
    while time.perf_counter() < end:
        call()
        cupy.cuda.Device().synchronize()
    times = []
    for _ in range(ROUNDS):
        begin, end = cupy.cuda.Event(), cupy.cuda.Event()
        begin.record()
        call()
        end.record()
        end.synchronize()
        times.append(cupy.cuda.get_elapsed_time(begin, end))
    return statistics.median(times)


def agrees(cupy, filters, name, radius, mode, dtype):
    import numpy as np
    import scipy.ndimage

    v = np.random.default_rng(2).integers(0, 200, (31, 40, 53)).astype(dtype)
    size = 2 * min(radius, 10) + 1
    want = getattr(scipy.ndimage, name)(v, size, mode=mode)
    got = cupy.asnumpy(getattr(filters, name)(cupy.asarray(v), size, mode=mode))
    return np.array_equal(want, got) if dtype != "float32" else np.allclose(want, got, rtol=1e-5)


def rows_of_cupy(cupy, filters):
    rng = cupy.random.default_rng(1)
    for dtype in TYPES:
        v = rng.integers(0, 256 if dtype == "uint8" else 65536, (SIZE,) * 3).astype(dtype)
        out = cupy.empty_like(v)
        for radius in [10, 40]:
            for name in ["uniform_filter", "minimum_filter", "maximum_filter"]:
                # Its default, once: it takes twice as long.
                for mode in ["nearest", "reflect"] if (dtype, radius) == ("uint8", 10) else ["nearest"]:
                    f = getattr(filters, name)
                    ms = timed(cupy, lambda: f(v, 2 * radius + 1, output=out, mode=mode))
                    same = agrees(cupy, filters, name, radius, mode, dtype)
                    yield f"CuPy {name} {mode}", dtype, radius, ms, "" if same else "differs from SciPy"


def smooth_rows(cupy, filters):
    """Gaussians cut at three sigma, and gradients."""
    import numpy as np
    import scipy.ndimage

    small = np.random.default_rng(4).integers(0, 200, (31, 40, 53)).astype("float32")
    rng = cupy.random.default_rng(5)
    for dtype in [t for t in TYPES if t != "float32"]:
        v = rng.integers(0, 256 if dtype == "uint8" else 65536, (SIZE,) * 3).astype(dtype)
        out = cupy.empty(v.shape, "float32")

        def sobel(module, a):
            parts = [module.sobel(a, axis, mode="nearest") for axis in range(3)]
            return (parts[0] ** 2 + parts[1] ** 2 + parts[2] ** 2) ** 0.5

        f = v.astype("float32")
        cases = []
        for sigma in [2, 6]:
            kind = dict(mode="nearest", truncate=3.0)
            cases.append((f"gaussian_filter s={sigma}", lambda m, a, s=sigma, k=kind: m.gaussian_filter(a, s, **k)))
            cases.append(
                (
                    f"gaussian_gradient_magnitude s={sigma}",
                    lambda m, a, s=sigma, k=kind: m.gaussian_gradient_magnitude(a, s, **k),
                )
            )
        cases.append(("sobel, three axes, magnitude", sobel))
        for name, case in cases:
            want, got = case(scipy.ndimage, small), cupy.asnumpy(case(filters, cupy.asarray(small)))
            note = "" if np.allclose(want, got, rtol=1e-4, atol=1e-3) else "differs from SciPy"
            # From f32: CuPy would make results of the integers' type.
            yield f"CuPy {name}", dtype, timed(cupy, lambda: cupy.copyto(out, case(filters, f))), note


def rows_of_torch(cupy):
    try:
        import torch
        from torch.nn.functional import avg_pool3d, max_pool3d
    except ImportError as e:
        print(f"torch is not there ({e}): its pools were not measured", file=sys.stderr)
        return
    if not torch.cuda.is_available():
        print("torch sees no CUDA device: its pools were not measured", file=sys.stderr)
        return
    v = torch.rand((1, 1) + (SIZE,) * 3, device="cuda")
    for radius in [10, 40]:
        size = 2 * radius + 1
        pools = {
            "torch avg_pool3d": lambda: avg_pool3d(v, size, 1, radius, count_include_pad=False),
            # max_pool3d pads at most half a window, which is all that is asked.
            "torch max_pool3d": lambda: max_pool3d(v, size, 1, radius),
        }
        for name, pool in pools.items():
            def one():
                pool()
                torch.cuda.synchronize()

            yield name, "float32", radius, timed(cupy, one), "events about a synchronised call"


def copies(cupy):
    import numpy as np

    host = np.random.default_rng(3).integers(0, 256, (SIZE,) * 3).astype("u1")
    pinned = cupy.cuda.alloc_pinned_memory(host.nbytes)
    staged = np.frombuffer(pinned, "u1", host.size).reshape(host.shape)
    staged[...] = host
    device = cupy.empty(host.shape, "u1")
    yield "copy there, u8, pinned", timed(cupy, lambda: device.set(staged))
    yield "copy back, u8, pinned", timed(cupy, lambda: device.get(out=staged))
    large = cupy.empty(1 << 28, "f4")
    other = cupy.empty_like(large)
    ms = timed(cupy, lambda: cupy.copyto(other, large))
    yield f"device copy rate: {2 * large.nbytes / ms / 1e9:.2f} TB/s read and written; 1 GiB", ms


def main():
    cupy, filters = cupy_or_skip()
    props = cupy.cuda.runtime.getDeviceProperties(0)
    print(f"{props['name'].decode()}, CuPy {cupy.__version__}, {SIZE}^3, medians of {ROUNDS}, ms")
    for name, ms in copies(cupy):
        print(f"{name:<60} {ms:8.3f}")
    parts = set(sys.argv[1:]) or {"windows", "smooth", "torch"}
    global TYPES
    TYPES = [t for t in TYPES if t in parts] or TYPES
    for name, dtype, radius, ms, note in rows_of_cupy(cupy, filters) if "windows" in parts else []:
        print(f"{name:<32} {dtype:<8} r={radius:<3} {ms:8.3f}  {note}")
    for name, dtype, ms, note in smooth_rows(cupy, filters) if "smooth" in parts else []:
        print(f"{name:<44} {dtype:<8} {ms:8.3f}  {note}")
    for name, dtype, radius, ms, note in rows_of_torch(cupy) if "torch" in parts else []:
        print(f"{name:<32} {dtype:<8} r={radius:<3} {ms:8.3f}  {note}")


if __name__ == "__main__":
    main()
