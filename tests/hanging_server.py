"""A server that cheats the vendor's client."""

import socket
import threading
from contextlib import contextmanager

from cfplan.flight.mocap.datastream import Block, kinds, packet


@contextmanager
def hanging_server(then_close):
    """A server that welcomes clients and never sends a frame, by its URI; it may stop listening after the first."""
    listener = socket.create_server(("127.0.0.1", 0))
    clients = []

    def run():
        try:
            while True:
                client, _ = listener.accept()
                clients.append(client)
                client.sendall(packet((Block.OBJECT_ENUMS, kinds([2, 5, 9]))))
                if then_close:
                    listener.close()
                    client.close()
        except OSError:
            return

    threading.Thread(target=run, daemon=True).start()
    try:
        yield f"vicon-sdk://127.0.0.1:{listener.getsockname()[1]}/cf1"
    finally:
        listener.close()
        for client in clients:
            client.close()
