"""A page of a viewer without a browser: it speaks with the server over a real connection."""

import contextlib
import json
import threading
import time

from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect


def wait_for(condition, seconds=20.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.02)


class Visitor:
    """Sees the page of a port. `seen` has the newest message of each kind, and `moments` counts those."""

    def __init__(self, port, **headers):
        self.seen, self.moments = {}, 0
        address = f"ws://127.0.0.1:{port}/stream"
        self.connection = connect(address, additional_headers=headers, max_size=None, close_timeout=0.5)
        threading.Thread(target=self._listen, daemon=True).start()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.connection.close()

    def send(self, message):
        """Sends text or bytes as they are."""
        with contextlib.suppress(ConnectionClosed):
            self.connection.send(message)

    def ask(self, name, value=True):
        """Gives a control a value, or presses a button."""
        self.send(json.dumps([name, value]))

    def control(self, name):
        """What the page shows of a control."""
        return next(control for control in self.seen["panel"] if control["name"] == name)

    def value(self, name):
        """The value of a control, or what the page says under that name."""
        wait_for(lambda: {"panel", "status"} <= set(self.seen))
        return self.seen["status"][name] if name in self.seen["status"] else self.control(name)["value"]

    def _listen(self):
        with contextlib.suppress(ConnectionClosed):
            for message in self.connection:
                found = json.loads(message)
                self.moments += "moment" in found
                self.seen |= found
