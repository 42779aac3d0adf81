"""Networks of the shipped ones' form whose result is known in closed form, as ONNX files."""

import hashlib
import json
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

SIZES = {"picture": [1, 3, "h", "w"], "aid": [1, 3, "h", "w"], "blur": [1, "c", "hh", "hw"]}
#: How far `coarse` looks: the dilated filter, then the mean of a square of 16 px, of which it is at most 15 px away.
COARSE_REACH_PX = 170 + 15


def network(nodes, constants=None, *, sizes=None, output="restored", kind=TensorProto.FLOAT):
    """An ONNX file with the given nodes, the last of which makes ``output``."""
    inputs = [helper.make_tensor_value_info(name, kind, size) for name, size in (sizes or SIZES).items()]
    outputs = [helper.make_tensor_value_info(output, TensorProto.FLOAT, [1, 3, None, None])]
    stored = [numpy_helper.from_array(np.asarray(v), name) for name, v in (constants or {}).items()]
    graph = helper.make_graph(nodes, "small", inputs, outputs, stored)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.checker.check_model(model)
    return model.SerializeToString()


def mixing(share=0.5, channels=(1.0, 1.0, 1.0)):
    """``channels (picture + share (aid - picture))``."""
    return network(
        [
            helper.make_node("Sub", ["aid", "picture"], ["difference"]),
            helper.make_node("Mul", ["difference", "share"], ["part"]),
            helper.make_node("Add", ["picture", "part"], ["sum"]),
            helper.make_node("Mul", ["sum", "channels"], ["restored"]),
        ],
        {"share": np.float32(share), "channels": np.asarray(channels, np.float32).reshape(1, 3, 1, 1)},
    )


def box():
    """Mean of 5 x 5 pixels of the picture; zeros beyond what the network sees."""
    return network(
        [helper.make_node("Conv", ["picture", "weights"], ["restored"], group=3, pads=[2, 2, 2, 2])],
        {"weights": np.full((3, 1, 5, 5), 1 / 25, np.float32)},
    )


def coarse():
    """A far-reaching filter, then means of squares of 16 px as a U-Net has them: they hang on where squares begin."""
    rng = np.random.default_rng(0)
    weights = rng.random((3, 1, 3, 3), np.float32)
    return network(
        [
            helper.make_node("Conv", ["picture", "weights"], ["far"], group=3, dilations=[170, 170], pads=[170] * 4),
            helper.make_node("AveragePool", ["far"], ["small"], kernel_shape=[16, 16], strides=[16, 16]),
            helper.make_node("Resize", ["small", "", "scales"], ["large"], mode="nearest"),
            helper.make_node("Add", ["large", "aid"], ["sum"]),
            helper.make_node("Mul", ["sum", "half"], ["restored"]),
        ],
        {
            "weights": weights / weights.sum(axis=(2, 3), keepdims=True),
            "scales": np.array([1, 1, 16, 16], np.float32),
            "half": np.float32(0.5),
        },
    )


def seeing_blur():
    """``(1 + blur) / 2``, each value for two by two pixels."""
    return network(
        [
            helper.make_node("Resize", ["blur", "", "scales"], ["large"], mode="nearest"),
            helper.make_node("Mul", ["large", "half"], ["part"]),
            helper.make_node("Add", ["part", "half"], ["restored"]),
        ],
        {"scales": np.array([1, 1, 2, 2], np.float32), "half": np.float32(0.5)},
    )


def write_weights(folder: Path, **models: bytes) -> None:
    """A folder of networks as the package has it."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, model in models.items():
        (folder / f"{name}.onnx").write_bytes(model)
    sums = {f"{name}.onnx": hashlib.sha256(model).hexdigest() for name, model in models.items()}
    (folder / "checksums.json").write_text(json.dumps(sums))
