"""The web server of live views."""

from __future__ import annotations

import contextlib
import io
import socket
from typing import TYPE_CHECKING

from concent_warp.errors import ConcentError

if TYPE_CHECKING:
    import viser


def started_server(host: str, port: int) -> viser.ViserServer:
    """Return a running server with an empty page.

    Args:
        host: Address to serve on; 127.0.0.1 is this machine alone.
        port: Port; the next free one where it is taken.

    Raises:
        ConcentError: The address cannot be served on.
    """
    import viser

    try:
        socket.create_server((host, 0)).close()  # viser would wait for ever
    except OSError as error:
        raise ConcentError("no page can be served at this address", where=host, found=error.strerror) from None
    with contextlib.redirect_stdout(io.StringIO()):  # it prints a banner
        server = viser.ViserServer(host=host, port=port, label="ConCent", verbose=False)
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    return server
