"""Trained weights as the package ships them: ONNX with half-precision weights, and their checksums."""

from __future__ import annotations

import hashlib
import json
import warnings
from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor

from scripts.restoration.network import RestorationNet, ThesisNet

#: The package's folder of weights.
WEIGHTS = Path(__file__).parents[2] / "colmap_inertial" / "imaging" / "restoration" / "weights"
_OPSET = 17


def export(network: RestorationNet | ThesisNet, path: Path) -> None:
    """Write a network as ONNX: any size of picture, weights in half precision, arithmetic in single precision."""
    network = network.to("cpu").eval().to(memory_format=torch.contiguous_format)
    picture, blur = torch.zeros(1, 3, 64, 64), torch.zeros(1, network.blur_channels, 32, 32)
    whole, half = {2: "height", 3: "width"}, {2: "half_height", 3: "half_width"}
    path.parent.mkdir(parents=True, exist_ok=True)
    with warnings.catch_warnings():
        # the exporter that needs no further package is called old; its result is what is checked below
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.onnx.export(
            network,
            (picture, picture, blur),
            str(path),
            input_names=["picture", "aid", "blur"],
            output_names=["restored"],
            dynamic_axes={"picture": whole, "aid": whole, "blur": half, "restored": whole},
            opset_version=_OPSET,
            dynamo=False,
        )
    model = onnx.load(path)
    _halve(model.graph)
    onnx.checker.check_model(model)
    onnx.save(model, path)
    _note_checksum(path)


def weights_of(path: Path, network: RestorationNet) -> dict[str, Tensor]:
    """The weights of an exported network as the state of ``network`` to begin with.

    Where that one is told more of the blur, it takes no notice of it at first.
    """
    stored = {w.name.removesuffix(".half"): w for w in onnx.load(path).graph.initializer}
    state = {}
    for name, own in network.state_dict().items():
        if name not in stored:
            raise SystemExit(f"{path}: holds no weights {name}")
        found = torch.from_numpy(numpy_helper.to_array(stored[name]).astype(np.float32))
        if name == "enter.weight" and found.shape[1] < own.shape[1]:
            found = torch.cat([found, torch.zeros_like(own[:, found.shape[1] :])], dim=1)
        if found.shape != own.shape:
            raise SystemExit(f"{path}: {name} has the shape {tuple(found.shape)}, not {tuple(own.shape)}")
        state[name] = found
    return state


def _halve(graph: onnx.GraphProto) -> None:
    """Store the weights of convolutions in half precision, cast back where they are used."""
    casts = []
    for weight in graph.initializer:
        if weight.data_type != TensorProto.FLOAT or len(weight.dims) == 0:
            continue
        name = weight.name
        short = numpy_helper.from_array(numpy_helper.to_array(weight).astype(np.float16), f"{name}.half")
        casts.append(helper.make_node("Cast", [short.name], [name], f"{name}.cast", to=TensorProto.FLOAT))
        weight.CopyFrom(short)
    nodes = [*casts, *graph.node]
    del graph.node[:]
    graph.node.extend(nodes)


def _note_checksum(path: Path) -> None:
    sums = path.parent / "checksums.json"
    known = json.loads(sums.read_text()) if sums.exists() else {}
    known[path.name] = hashlib.sha256(path.read_bytes()).hexdigest()
    sums.write_text(json.dumps(dict(sorted(known.items())), indent=2) + "\n")
