"""Strangers get nothing from the viewer, and its own page cannot break it for the next one."""

import contextlib
import http.client
import socket
import time
from urllib.parse import urlsplit

import msgspec
import pytest
import viser
from websockets.exceptions import InvalidStatus, WebSocketException
from websockets.sync.client import connect

from colmap_inertial.core.errors import OutputError
from colmap_inertial.tools.view import load_scene
from colmap_inertial.tools.view.guard import LIMITS, Guard, guarding, is_allowed, is_loopback
from colmap_inertial.tools.view.server import Viewer
from tests.helpers.cases import loop_over
from tests.tools.view.test_view import ESTIMATE, write_result

_ENDED = (WebSocketException, OSError)


@pytest.fixture(scope="module")
def viewer(tmp_path_factory):
    root = tmp_path_factory.mktemp("guard") / "out"
    write_result(root, [ESTIMATE])
    shown = Viewer(load_scene(root), port=0)
    yield shown
    shown.close()


@pytest.fixture
def place(viewer):
    """Port and token."""
    url = urlsplit(viewer.url)
    return url.port, url.path.strip("/")


def get(port, path, **headers):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    with contextlib.closing(connection):
        connection.putrequest("GET", path, skip_host=True)
        for name, value in {"Host": f"127.0.0.1:{port}", **headers}.items():
            connection.putheader(name, value)
        connection.endheaders()
        answer = connection.getresponse()
        return answer.status, answer.read(), dict(answer.getheaders())


def opened(port, token, *, origin="", host="", **settings):
    """A websocket; the test's own Origin and Host."""
    name = host or f"127.0.0.1:{port}"
    return connect(
        f"ws://{name}/{token}",
        sock=socket.create_connection(("127.0.0.1", port)),
        origin=f"http://{name}" if origin == "" else origin,
        subprotocols=[f"viser-v{viser.__version__}"],
        open_timeout=10,
        max_size=None,
        proxy=None,
        **settings,
    )


def refused(port, token, **how):
    """The answer's status and body."""
    with pytest.raises(InvalidStatus) as caught, opened(port, token, **how) as socket_:
        socket_.recv(timeout=5)
    return caught.value.response.status_code, caught.value.response.body


def test_the_right_address_shows_the_page_and_the_scene(place):
    port, token = place
    for path in (f"/{token}", f"/{token}/", f"/{token}/?x=1"):
        status, body, headers = get(port, path)
        assert status == 200 and b"<html" in body
    assert headers["Referrer-Policy"] == "no-referrer" and headers["Cache-Control"] == "no-store"
    with opened(port, token) as own:
        assert len(own.recv(timeout=10)) > 1000
    name = f"localhost:{port + 1}"  # forwarded from another port
    assert get(port, f"/{token}", Host=name)[0] == 200
    with opened(port, token, host=name) as own:
        assert own.recv(timeout=10)


@loop_over("origin", ["https://evil.example", "null", "http://127.0.0.1:1", "http://localhost", None])
def test_a_foreign_origin_gets_no_byte_of_the_scene(place, origin):
    port, token = place
    assert refused(port, token, origin=origin) == (403, b"Forbidden\n")
    if origin is not None:
        assert get(port, f"/{token}", Origin=origin)[:2] == (403, b"Forbidden\n")


HOSTS = ["evil.example", "evil.example:80", "127.0.0.1.evil.example", "127.0.0.1@evil.example", "192.0.2.7", "0.0.0.0"]


@loop_over("host", [*HOSTS, "localhost.", "[::", "", "\xe9"])
def test_another_host_name_gets_nothing(place, host):
    port, token = place
    assert get(port, f"/{token}", Host=host)[:2] == (403, b"Forbidden\n")
    if host and host.isascii() and not {"[", "@"} & set(host):
        assert refused(port, token, host=host) == (403, b"Forbidden\n")


@loop_over("wrong", ["", "x", "index.html", "{}x", "x{}", "x/{}", "%2e%2e/{}", "?{}", "//{}"])
def test_without_the_token_there_is_nothing(place, wrong):
    port, token = place
    path = wrong.replace("{}", token)
    assert get(port, f"/{path}")[:2] == (403, b"Forbidden\n")
    assert refused(port, path) == (403, b"Forbidden\n")


def test_bytes_that_are_no_path_get_nothing(place):
    with socket.create_connection(("127.0.0.1", place[0]), timeout=10) as raw:
        raw.sendall(b"GET /\xff\xfe HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert raw.recv(1000).startswith(b"HTTP/1.1 403")


def test_two_viewers_have_two_tokens(viewer):
    assert Guard(host="127.0.0.1").token != Guard(host="127.0.0.1").token
    assert len(urlsplit(viewer.url).path) > 30
    assert "token" not in repr(Guard(host="127.0.0.1"))


def test_on_the_network_addresses_and_own_names_are_hosts_but_no_others():
    guard = Guard(host="0.0.0.0")
    path = f"/{guard.token}"
    for name in ("192.0.2.7:8080", "[2001:db8::1]:8080", "localhost:8080", socket.gethostname()):
        assert guard.admits(path, [name], [f"http://{name}"], websocket=True), name
    assert not guard.admits(path, ["evil.example:8080"], ["http://evil.example:8080"], websocket=True)
    assert not guard.admits(path, ["localhost", "localhost"], [], websocket=False)
    assert [is_loopback(h) for h in ("127.0.0.1", "::1", "localhost", "0.0.0.0", "192.0.2.7")] == [1, 1, 1, 0, 0]


def test_connections_are_bounded(place):
    port, token = place
    with contextlib.ExitStack() as stack:
        for _ in range(LIMITS.viewers):
            stack.enter_context(opened(port, token))
        assert refused(port, token)[0] == 503
        silent = [socket.create_connection(("127.0.0.1", port)) for _ in range(2 * LIMITS.connections)]
        time.sleep(0.3)
        for one in silent:
            stack.enter_context(one)
            one.setblocking(False)
        ended = 0
        for one in silent:
            with contextlib.suppress(BlockingIOError):
                try:
                    ended += one.recv(1) == b""
                except ConnectionResetError:
                    ended += 1
        assert ended >= 2 * LIMITS.connections - (LIMITS.connections - LIMITS.viewers)
        with pytest.raises(_ENDED):
            opened(port, token)
    for _ in range(50):  # they are gone again
        with contextlib.suppress(*_ENDED), opened(port, token) as own:
            assert own.recv(timeout=10)
            return
        time.sleep(0.2)
    pytest.fail("the viewer does not answer any more")


def said(own, **message):
    own.send(msgspec.msgpack.encode(message))


def test_no_message_silences_the_slider_for_the_next_one(viewer, place):
    port, token = place
    slider = viewer._slider._impl
    handlers = list(slider.update_cb)
    with opened(port, token) as evil:
        evil.recv(timeout=10)
        for updates in ({"update_cb": []}, {"value": 1, "update_cb": []}, {"sync_cb": None}, {"value": "x"},
                        {"value": float("nan")}, {"removed": True}, {}):  # fmt: skip
            said(evil, type="GuiUpdateMessage", uuid=slider.uuid, updates=updates)
        said(evil, type="ShareUrlRequest")
        said(evil, type="FileTransferStartUpload", source_component_uuid=slider.uuid, transfer_uuid="x", filename="x",
             mime_type="x", part_count=1, size_bytes=1)  # fmt: skip
        evil.send(b"\xff\x00 no msgpack")
        evil.send("text")
    with opened(port, token) as next_one:
        next_one.recv(timeout=10)
        camera = {"wxyz": [1, 0, 0, 0], "position": [0, 0, 1], "fov": 1.0, "near": 0.1, "far": 100.0,
                  "image_height": 100, "image_width": 100, "look_at": [0, 0, 0], "up_direction": [0, 0, 1]}  # fmt: skip
        said(next_one, type="ViewerCameraMessage", **camera)
        time.sleep(0.3)
        said(next_one, type="GuiUpdateMessage", uuid=slider.uuid, updates={"value": 3})
        for _ in range(100):
            if viewer.scene.cameras.names[3] in viewer._about.content.replace("\\", ""):
                break
            time.sleep(0.1)
        assert slider.value == 3
        assert viewer.scene.cameras.names[3] in viewer._about.content.replace("\\", "")
    assert slider.update_cb == handlers and slider.sync_cb is not None and not slider.removed


def test_what_the_page_sends_is_let_through():
    click = {"type": "ScenePointerMessage", "event_type": "click", "ray_origin": [0.0, 1, 2], "ray_direction": None,
             "screen_pos": [[0.5, 0.5]], "modifier": None}  # fmt: skip
    assert is_allowed(click)
    assert not is_allowed({**click, "owner": "x"})
    assert not is_allowed({**click, "ray_origin": [float("inf"), 0, 0]})
    assert not is_allowed({"type": "RunJavascriptMessage", "source": "x"})
    assert not is_allowed([1]) and not is_allowed({"type": []})


def test_a_viser_that_listens_in_another_way_is_not_served():
    with pytest.raises(OutputError, match="viser"), guarding(Guard(host="127.0.0.1")):
        pass
