#!/usr/bin/env python3
"""Opens outputs with other people's readers and compares level 0 with NumPy files.

    check_outputs.py OUTPUT [OUTPUT ...] [--expect FILE.npy]

Without --expect, an OUTPUT is compared with NAME.level0.npy beside it, if that exists. Packages: numpy; for Zarr zarr (3),
tensorstore and, where installed, ome_zarr_models; for .nii nibabel; for .nrrd pynrrd. Exit code 1 on the first fault.
"""

import argparse
import json
import pathlib
import sys

import numpy as np


def same(name, got, want):
    got = np.asarray(got)
    if want is None:
        return
    if got.shape != want.shape or got.dtype != want.dtype:
        raise SystemExit(f"{name}: {got.dtype} {got.shape}, expected {want.dtype} {want.shape}")
    if not np.array_equal(got, want, equal_nan=want.dtype.kind == "f"):
        differ = (got != want) & ~((got != got) & (want != want))
        raise SystemExit(f"{name}: {np.count_nonzero(differ)} voxels differ")


def check_zarr(path, want):
    import tensorstore
    import zarr

    group = zarr.open_group(str(path), mode="r")
    attributes = dict(group.attrs)
    v3 = "ome" in attributes
    image = (attributes["ome"] if v3 else attributes)["multiscales"][0]
    names = [axis["name"] for axis in image["axes"]]
    scale0 = None
    for i, dataset in enumerate(image["datasets"]):
        array = group[dataset["path"]]
        assert len(array.shape) == len(names), f"{path}: {array.shape} for axes {names}"
        if v3:
            assert list(array.metadata.dimension_names) == names, f"{path}: dimension names"
        kinds = [t["type"] for t in dataset["coordinateTransformations"]]
        assert kinds == ["scale", "translation"], f"{path}: {kinds}"
        scale = dataset["coordinateTransformations"][0]["scale"]
        scale0 = scale0 or scale
        factors = [s / s0 for s, s0 in zip(scale, scale0)]
        assert all(f == round(f) for f in factors), f"{path}: level {i} is no whole multiple of level 0"
        voxels = array[...]
        same(f"{path} level {i} (zarr)", voxels, want if i == 0 else None)
        driver = "zarr3" if v3 else "zarr"
        store = {"driver": "file", "path": str(path / dataset["path"])}
        opened = tensorstore.open({"driver": driver, "kvstore": store}, read=True).result()
        same(f"{path} level {i} (tensorstore)", opened.read().result(), np.asarray(voxels))
    check_models(path, v3)
    return attributes.get("occlude", {})


def check_models(path, v3):
    try:
        import zarr
        from ome_zarr_models.v04.image import Image as Image04
        from ome_zarr_models.v05.image import Image as Image05
    except ImportError:
        return
    (Image05 if v3 else Image04).from_zarr(zarr.open_group(str(path), mode="r"))


def check_nifti(path, want):
    import nibabel

    image = nibabel.load(str(path))
    voxels = np.asanyarray(image.dataobj)
    same(str(path), voxels.T, want)
    q, s = image.get_qform(), image.get_sform()
    if image.header["qform_code"]:
        assert np.allclose(q, s, atol=1e-5), f"{path}: qform {q} is not sform {s}"
    spacing = nibabel.affines.voxel_sizes(image.affine)
    assert np.allclose(spacing, image.header.get_zooms()[:3]), f"{path}: {spacing} is not pixdim"
    return {}


def check_nrrd(path, want):
    import nrrd

    voxels, header = nrrd.read(str(path))
    same(str(path), voxels.T, want)
    return {"config_hash": header.get("occlude_config_hash")}


def check(path, expect):
    beside = path.with_name(path.name.rsplit(".", 1)[0] + ".level0.npy")
    if expect is None and beside.exists():
        expect = beside
    want = np.load(expect) if expect else None
    if path.is_dir():
        occlude = check_zarr(path, want)
        assert occlude.get("complete") is True, f"{path}: not complete"
    elif path.suffix == ".npy":
        same(str(path), np.load(path), want)
    elif path.suffix == ".nii":
        check_nifti(path, want)
    elif path.suffix == ".nrrd":
        check_nrrd(path, want)
    elif path.suffix == ".raw":
        meta = json.loads((path.parent / (path.name + ".occlude") / "meta.json").read_text())
        kind = {"u": "uint", "i": "int", "f": "float"}[meta["dtype"][0]] + meta["dtype"][1:]
        same(str(path), np.fromfile(path, dtype=kind).reshape(meta["shape"]), want)
    else:
        raise SystemExit(f"{path}: no reader for this name")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("outputs", nargs="+", type=pathlib.Path)
    parser.add_argument("--expect", type=pathlib.Path)
    arguments = parser.parse_args()
    for path in arguments.outputs:
        try:
            check(path, arguments.expect)
        except AssertionError as error:
            raise SystemExit(str(error)) from error
    print(f"{len(arguments.outputs)} outputs are fine")


if __name__ == "__main__":
    sys.exit(main())
