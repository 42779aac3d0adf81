"""Access control of the viewer: connections, and messages from them.

viser serves whoever reaches its port: any web page in the same browser can open its socket and read the scene, and a
message can set any field of a control, its callbacks included. It has no setting for this, and a proxy before it would
leave its own port open beside the proxy's. But viser listens by the public ``websockets.asyncio.server.serve``, so that
what that function is given is completed here, while viser starts: every request passes :meth:`Guard.admits`, every
message :func:`is_allowed`. A viser that listens in any other way is not served at all.
"""

from __future__ import annotations

import contextlib
import http
import ipaddress
import logging
import math
import re
import secrets
import socket
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

from colmap_inertial.core.errors import OutputError
from colmap_inertial.core.facts import Fact

log = logging.getLogger(__name__)
log.addHandler(logging.NullHandler())  # what strangers send is no news for the terminal

#: What the panel's controls and the canvas send.
_SPOKEN = {
    "ViewerCameraMessage": {
        *("wxyz", "position", "fov", "near", "far", "image_height", "image_width", "look_at", "up_direction"),
    },
    "ScenePointerMessage": {"event_type", "ray_origin", "ray_direction", "screen_pos", "modifier"},
    "GuiUpdateMessage": {"uuid", "updates"},
}
_HEADERS = {
    "Cache-Control": "no-store",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",  # the address holds the secret
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}
#: An address in brackets or a name, and perhaps a port.
_HOST = re.compile(r"(?:\[([0-9A-Fa-f:.]+)\]|([0-9A-Za-z._-]+))(?::\d{1,5})?")
_patching = threading.Lock()


@dataclass(frozen=True, kw_only=True)
class ConnectionLimits:
    """Limits of a connection's resources."""

    viewers: int = 16
    """At the same time."""
    connections: int = 48
    """TCP connections at the same time, those among them that have not sent anything yet."""
    open_timeout_s: float = 5.0
    """A request has to be complete by then."""
    message_bytes: int = 1 << 16
    """Clicks and poses are shorter."""


LIMITS = ConnectionLimits()


@dataclass(frozen=True, kw_only=True)
class Guard:
    """The rules of one viewer.

    Attributes
    ----------
    host
        Where it listens.
    token
        The first part of every path; who does not know it gets nothing.
    """

    host: str
    token: str = field(default_factory=lambda: secrets.token_urlsafe(24), repr=False)

    def admits(self, path: str, hosts: list[str], origins: list[str], *, websocket: bool) -> bool:
        """Whether a request may be answered.

        Parameters
        ----------
        path
            Of the request.
        hosts, origins
            All its headers ``Host`` and ``Origin``.
        websocket
            It asks for the websocket, for which browsers always state the origin.
        """
        if len(hosts) != 1 or not self._is_own(hosts[0]):
            return False
        if len(origins) > 1 or (websocket and not origins):
            return False
        if origins and origins[0] not in (f"http://{hosts[0]}", f"https://{hosts[0]}"):
            return False
        first_part = path.partition("?")[0].removeprefix("/").partition("/")[0]
        return secrets.compare_digest(first_part.encode(errors="surrogateescape"), self.token.encode())

    def _is_own(self, host: str) -> bool:
        """Whether a ``Host`` header names this machine.

        A page that had its own name lead here (DNS rebinding) would pass for one of ours; an address cannot be made to
        do so. Any port: it may have been forwarded.
        """
        match = _HOST.fullmatch(host)
        if match is None:
            return False
        name = (match[1] or match[2]).lower()
        known = {"localhost", self.host.lower()}
        if not is_loopback(self.host):
            own = socket.gethostname().lower()
            known |= {own, f"{own}.local"}
        try:
            address = ipaddress.ip_address(name)
        except ValueError:
            return name in known
        return address.is_loopback or not is_loopback(self.host)


def is_loopback(host: str) -> bool:
    """Whether nobody on the network can reach an address to listen at."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"


def is_allowed(message: Any) -> bool:
    """Whether a decoded message is one of the viewer's own page: a click, a pose, the value of a control."""
    if not isinstance(message, dict) or not isinstance(message.get("type"), str):
        return False
    known = _SPOKEN.get(message["type"])
    if known is None or message.keys() != known | {"type"} or not _is_finite(list(message.values())):
        return False
    if message["type"] != "GuiUpdateMessage":
        return True
    updates = message["updates"]
    return (
        isinstance(message["uuid"], str)
        and isinstance(updates, dict)
        and updates.keys() == {"value"}
        and isinstance(updates["value"], bool | int | float)
    )


def _is_finite(value: Any, depth: int = 0) -> bool:
    if isinstance(value, float | int):
        return math.isfinite(value) and abs(value) < 1e12
    if isinstance(value, dict | list):
        items = value.values() if isinstance(value, dict) else value
        return depth < 3 and all(_is_finite(item, depth + 1) for item in items)
    return value is None or isinstance(value, str)


@contextlib.contextmanager
def guarding(guard: Guard) -> Iterator[None]:
    """While viser starts inside the block, have it listen under a guard.

    Raises
    ------
    OutputError
        At the end, where it did not start in the way that is known: it is not guarded then and must be stopped.
    """
    import websockets.asyncio.server as server

    started = []
    with _patching:
        serve = server.serve

        def guarded(handler: Callable[..., Any], *args: Any, **settings: Any) -> Any:
            if not handler.__module__.startswith("viser.") or "process_request" not in settings:
                return serve(handler, *args, **settings)
            started.append(handler)
            return serve(_quiet(handler), *args, **_complete_settings(guard, settings))

        server.serve = guarded  # type: ignore[assignment, misc]
        try:
            yield
        finally:
            server.serve = serve  # type: ignore[misc]
    if not started:
        raise OutputError(Fact("viser-not-guarded"))


def _quiet(handler: Callable[..., Any]) -> Callable[..., Any]:
    async def handled(connection: Any) -> None:
        try:
            await handler(connection)
        except Exception:
            log.debug("a viewer's connection failed", exc_info=True)

    return handled


def _complete_settings(guard: Guard, settings: dict[str, Any]) -> dict[str, Any]:
    """Complete the settings that viser gives ``serve``."""
    import msgspec.msgpack
    from websockets.asyncio.connection import Connection
    from websockets.asyncio.server import ServerConnection

    inner = settings["process_request"]
    connections: set[Any] = set()
    viewers: set[Any] = set()

    class Guarded(ServerConnection):
        def connection_made(self, transport: Any) -> None:
            if len(connections) >= LIMITS.connections:
                Connection.connection_made(self, transport)
                transport.abort()
                return
            connections.add(self)
            super().connection_made(transport)

        def connection_lost(self, exc: Exception | None) -> None:
            connections.discard(self)
            viewers.discard(self)
            super().connection_lost(exc)

        async def recv(self, decode: bool | None = None) -> Any:
            while True:
                data = await super().recv(decode)
                with contextlib.suppress(ValueError, RecursionError):  # msgspec's errors are ValueErrors
                    if isinstance(data, bytes) and is_allowed(msgspec.msgpack.decode(data)):
                        return data

    def process_request(connection: Any, request: Any) -> Any:
        headers = request.headers
        wants_socket = bool(headers.get_all("Upgrade"))
        if not guard.admits(request.path, headers.get_all("Host"), headers.get_all("Origin"), websocket=wants_socket):
            return connection.respond(http.HTTPStatus.FORBIDDEN, "Forbidden\n")
        if wants_socket:
            if len(viewers) >= LIMITS.viewers:
                return connection.respond(http.HTTPStatus.SERVICE_UNAVAILABLE, "Too many viewers\n")
            viewers.add(connection)
            return None
        rest = request.path.partition("?")[0].removeprefix(f"/{guard.token}")
        response = inner(connection, replace(request, path=rest or "/"))
        for name, value in _HEADERS.items():
            response.headers[name] = value
        return response

    return {
        **settings,
        "process_request": process_request,
        "create_connection": Guarded,
        "open_timeout": LIMITS.open_timeout_s,
        "max_size": LIMITS.message_bytes,
        "logger": log,
    }
