"""A browser of the live page without a browser: it speaks viser's protocol over a real connection."""

import contextlib
import threading
import time

import msgspec
import viser
import zstandard
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": [1.0, 0.0, 0.0, 0.0],
    "position": [-2.6, -1.8, 1.5],
    "fov": 1.0,
    "near": 0.01,
    "far": 1000.0,
    "image_height": 480,
    "image_width": 640,
    "look_at": [0.0, 0.0, 0.5],
    "up_direction": [0.0, 0.0, 1.0],
}


def wait_for(condition, seconds=20.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.02)


class Visitor:
    """Sees the page of a port."""

    def __init__(self, port, **headers):
        self.controls = {}
        self._labels = {}
        self._node = ""
        self.connection = connect(
            f"ws://127.0.0.1:{port}",
            subprotocols=[f"viser-v{viser.__version__}"],
            additional_headers=headers,
            max_size=None,
            close_timeout=0.5,
        )
        threading.Thread(target=self._listen, daemon=True).start()
        self.send(**CAMERA)
        wait_for(lambda: "Episode" in self.controls)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.connection.close()

    def send(self, **message):
        """Sends a message as it is."""
        with contextlib.suppress(ConnectionClosed):
            self.connection.send(msgspec.msgpack.encode(message))

    def change(self, label, value=True):
        """Gives a control a value, or presses a button. As in viser's page it shows the value at once."""
        control = self.controls[label]
        self.send(type="GuiUpdateMessage", uuid=control["uuid"], updates={"value": value})
        control["value"] = value

    def press(self, key):
        """Triggers the command with this label."""
        self.send(type="CommandTriggerMessage", uuid=self.controls[key]["uuid"])

    def drag(self, phase, x):
        """Drags the robot along x, m."""
        start, end = [0.0, 0.0, 0.5], [x, 0.0, 0.5]
        self.send(
            type="SceneNodeDragMessage",
            phase=phase,
            name=self._node,
            instance_index=None,
            start_position=start,
            start_screen_pos=[0.5, 0.5],
            end_position=end,
            end_screen_pos=[0.5, 0.5],
            button="left",
            modifier=None,
            owner="",
        )

    def value(self, label):
        """What the page shows in a control."""
        return self.controls[label]["value"]

    def text(self):
        """Everything that the page says in Markdown."""
        return "\n".join(control["_markdown"] for control in list(self.controls.values()) if "_markdown" in control)

    def _listen(self):
        with contextlib.suppress(ConnectionClosed):
            for packet in self.connection:
                size = int.from_bytes(packet[8:16], "little")
                inner = msgspec.msgpack.decode(zstandard.decompress(packet[16 : 16 + size]))
                for message in inner["messages"]:
                    self._take(message)

    def _take(self, message):
        kind, uuid = message["type"], message.get("uuid")
        if "props" in message and uuid is not None:
            label = message["props"].get("label") or uuid
            self._labels[uuid] = label
            self.controls[label] = {"uuid": uuid, "value": message.get("value"), **message["props"]}
        elif kind == "GuiUpdateMessage" and uuid in self._labels:
            self.controls[self._labels[uuid]].update(message["updates"])
        elif kind == "SetSceneNodeDragBindingsMessage" and message["bindings"]:
            self._node = message["name"]
