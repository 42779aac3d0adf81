"""A network that restores images, of any size, within bounded memory."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, TypeVar
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import NDArray

from colmap_inertial.core.arrays import AnyArray, Float32Array
from colmap_inertial.core.errors import FormatError, InertialError, MissingExtraError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.threads import usable_processors
from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.blur_path import BlurPath
from colmap_inertial.imaging.restoration import _tiles
from colmap_inertial.imaging.restoration.shipped import NetworkName, model_file, read_model

if TYPE_CHECKING:
    import onnxruntime

Device = Literal["auto", "cpu", "cuda"]
Sample = TypeVar("Sample", np.uint8, np.uint16, np.float32)

_CUDA, _CPU = "CUDAExecutionProvider", "CPUExecutionProvider"
#: What networks take; images have three channels, "blur" these, and half the height and width.
_INPUTS = ("picture", "aid", "blur")
_BLUR_CHANNELS: dict[NetworkName, int] = {"deepgyro": 5, "lsd2": 3}
_OUTPUT = "restored"


@dataclass(frozen=True, eq=False, kw_only=True)
class Network:
    """A network that is ready to run, in any number of threads at once; `load_network` makes it.

    Attributes
    ----------
    name
        Which one.
    device
        What it runs on.
    threads
        That an image may use on the processor. Images that are restored at once share them, beside the thread of
        each.
    """

    name: NetworkName
    device: Literal["cpu", "cuda"]
    threads: int
    _session: onnxruntime.InferenceSession = field(repr=False)

    @classmethod
    def of(
        cls, model: bytes, name: NetworkName, *, source: str, device: Device = "auto", threads: int | None = None
    ) -> Network:
        """The network in an ONNX file.

        Parameters
        ----------
        model
            The file's content. Inputs ``picture`` and ``aid`` (1, 3, H, W) and ``blur`` (1, C, H / 2, W / 2), C 5 for
            DeepGyro and 3 for LSD2, output ``restored`` (1, 3, H, W), all float32, for any H and W that are multiples
            of 16.
        name
            What the network does.
        source
            The file, for messages.
        device, threads
            As for `load_network`.

        Raises
        ------
        MissingExtraError
            Where onnxruntime is not installed.
        FormatError
            Where this is no such network.
        InertialError
            Where CUDA is asked for by name and cannot be used.
        """
        if threads is not None and threads < 1:
            raise ValueError("threads must be at least 1")
        threads = threads or usable_processors()
        session = _start_session(model, source, _choose_device(device), threads)
        on: Literal["cpu", "cuda"] = "cuda" if _CUDA in session.get_providers() else "cpu"
        network = cls(name=name, device=on, threads=threads, _session=session)
        _require_device(network, device)
        _require_contract(session, source, _BLUR_CHANNELS[name])
        return network

    def restore(
        self, image: NDArray[Sample], aid: AnyArray, blur: BlurPath | BlurField | None = None
    ) -> NDArray[Sample]:
        """Restore an image.

        Parameters
        ----------
        image
            (H, W) or (H, W, 3) sRGB: codes of uint8 or uint16, or float32 from 0 to 1.
        aid
            Likewise, of the same shape: the second image of the scene, for DeepGyro the path filter's result, for
            LSD2 the long exposure.
        blur
            Of the same size, for DeepGyro a path, for LSD2 a field; ``None`` where nothing is known of it.

        Returns
        -------
        A new image of the same shape and type as ``image``.

        Notes
        -----
        Large images go through in parts, each with 192 px around it; the package's networks look no further, so the
        result is the same as in one piece. Beside the result, memory does not grow with the image.

        Raises
        ------
        ValueError
            Where images are of another type, or do not go together.
        InertialError
            Where the device fails, as for want of memory.
        """
        _require_images(image, aid, blur)
        self._require_kind(blur)
        result = np.empty_like(image, order="C")
        for row, column in _tiles.tiles(*image.shape[:2]):
            feeds = {
                "picture": _tiles.feed(image, row, column),
                "aid": _tiles.feed(aid, row, column),
                "blur": self._blur_feed(blur, row, column),
            }
            try:
                (restored,) = self._session.run([_OUTPUT], feeds)
            except Exception as error:  # as in _start_session
                raise InertialError(
                    Fact("network-failed", network=self.name, device=self.device, detail=_first_line(error))
                ) from None
            _tiles.put(result, np.asarray(restored, dtype=np.float32)[0], row, column)
        return result

    def _require_kind(self, blur: BlurPath | BlurField | None) -> None:
        wanted = BlurPath if self.name == "deepgyro" else BlurField
        if blur is not None and not isinstance(blur, wanted):
            raise ValueError(f"blur: {self.name} takes a {wanted.__name__}, not a {type(blur).__name__}")

    def _blur_feed(self, blur: BlurPath | BlurField | None, row: _tiles.Span, column: _tiles.Span) -> Float32Array:
        if blur is None:
            return np.zeros((1, _BLUR_CHANNELS[self.name], row.size // 2, column.size // 2), dtype=np.float32)
        if isinstance(blur, BlurPath):
            return _tiles.path_feed(blur, row, column)
        return _tiles.blur_feed(blur, row, column)


def load_network(name: NetworkName, *, device: Device = "auto", threads: int | None = None) -> Network:
    """A network that comes with the package.

    Who asks for the same one again while it is in use gets the same one.

    Parameters
    ----------
    name
        ``"deepgyro"`` or ``"lsd2"``.
    device
        ``"auto"``: CUDA where onnxruntime has it, else the processor.
    threads
        That an image may use on the processor; as many as the process may use where absent. Where several threads
        restore images of their own, they share all but one of these, which each of them has for itself.

    Raises
    ------
    MissingExtraError
        Where onnxruntime is not installed.
    FormatError
        Where the network's file is missing or damaged.
    InertialError
        Where CUDA is asked for by name and cannot be used.
    """
    key = name, _choose_device(device), threads or usable_processors()
    with _LOCK:
        network = _LOADED.get(key)
        if network is None:
            model = read_model(name)
            network = Network.of(model, name, source=str(model_file(name)), device=device, threads=threads)
            _LOADED[key] = network
    _require_device(network, device)
    return network


def require_network(name: NetworkName) -> None:
    """Say early where a network cannot run, before hours of work that ends in it.

    Raises
    ------
    MissingExtraError
        Where onnxruntime is not installed.
    FormatError
        Where the network's file is missing or damaged.
    """
    _import_runtime()
    read_model(name)


_LOCK = threading.Lock()
#: By name, device and threads.
_LOADED: WeakValueDictionary[tuple[str, str, int], Network] = WeakValueDictionary()


def _import_runtime() -> Any:
    try:
        import onnxruntime
    except ImportError:
        raise MissingExtraError("restore", Fact("needs-onnxruntime")) from None
    return onnxruntime


def _choose_device(device: Device) -> Literal["cpu", "cuda"]:
    """Devices to try, in order."""
    available = _CUDA in _import_runtime().get_available_providers()
    if device == "cuda" and not available:
        raise InertialError(Fact("onnxruntime-without-cuda"))
    return "cuda" if available and device != "cpu" else "cpu"


def _require_device(network: Network, device: Device) -> None:
    """Raise where a device was asked for by name, and onnxruntime could not start on it."""
    if device == "cuda" and network.device != "cuda":
        raise InertialError(Fact("cuda-not-usable", network=network.name))


def _start_session(
    model: bytes, source: str, device: Literal["cpu", "cuda"], threads: int
) -> onnxruntime.InferenceSession:
    runtime = _import_runtime()
    options = runtime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 3  # errors
    # what it would remember of each size of image takes half as much memory again, and saves no time
    options.enable_mem_pattern = False
    # threads rest between two runs
    options.add_session_config_entry("session.force_spinning_stop", "1")
    cuda = [(_CUDA, {"cudnn_conv_algo_search": "HEURISTIC"})] if device == "cuda" else []
    try:
        return runtime.InferenceSession(model, options, providers=[*cuda, _CPU])
    # onnxruntime has an exception of its own for each of its codes, without a common base
    except Exception as error:
        raise FormatError(source, Fact("not-a-network", detail=_first_line(error))) from None


def _require_contract(session: onnxruntime.InferenceSession, source: str, blur_channels: int) -> None:
    """Raise where a network is not of the kind that `Network.of` describes."""
    inputs = {node.name: node.type for node in session.get_inputs()}
    outputs = [node.name for node in session.get_outputs()]
    if inputs != dict.fromkeys(_INPUTS, "tensor(float)") or _OUTPUT not in outputs:
        raise FormatError(
            source,
            Fact(
                "wrong-network",
                takes=tuple(f"{k} {v}" for k, v in inputs.items()),
                gives=outputs,
                wanted_takes=_INPUTS,
                wanted_gives=_OUTPUT,
            ),
        )
    for height, width in ((32, 48), (48, 32)):
        image = np.zeros((1, 3, height, width), dtype=np.float32)
        blur = np.zeros((1, blur_channels, height // 2, width // 2), dtype=np.float32)
        try:
            (restored,) = session.run([_OUTPUT], {"picture": image, "aid": image, "blur": blur})
        except Exception as error:  # as above
            raise FormatError(
                source, Fact("network-does-not-run", width=width, height=height, detail=_first_line(error))
            ) from None
        shape = np.shape(restored)
        if shape != image.shape:
            raise FormatError(source, Fact("network-changes-size", made=shape, given=image.shape))


def _first_line(error: Exception) -> str:
    return next(iter(str(error).strip().splitlines()), type(error).__name__)[:200]


def _require_images(image: AnyArray, aid: AnyArray, blur: BlurPath | BlurField | None) -> None:
    for name, array in (("image", image), ("aid", aid)):
        if array.dtype not in (np.uint8, np.uint16, np.float32):
            raise ValueError(f"{name}: uint8, uint16 or float32, not {array.dtype}")
    if image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] != 3) or 0 in image.shape:
        raise ValueError(f"image: (H, W) or (H, W, 3), not {image.shape}")
    if aid.shape != image.shape:
        raise ValueError(f"aid: of the image's shape {image.shape}, not {aid.shape}")
    if blur is not None and (blur.height, blur.width) != image.shape[:2]:
        raise ValueError(
            f"blur: for {blur.width} x {blur.height} px, the image has {image.shape[1]} x {image.shape[0]}"
        )
