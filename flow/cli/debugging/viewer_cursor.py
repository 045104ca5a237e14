"""The instant of `--at cursor`: where the time cursor of an open viewer is."""

from __future__ import annotations

import socket
from typing import TYPE_CHECKING

from flow.cli.arguments import CURSOR
from flow.errors import UsageError

if TYPE_CHECKING:
    import numpy as np

    from flow.cli.arguments import At

PORT = 9876  # on which the first viewer of this machine listens
OPEN = "open the recording with rerun, or give --at a time"


def without_cursor(at: At, port: int = PORT) -> float | np.datetime64 | np.timedelta64:
    """An instant of the command line, that of the viewer in place of CURSOR.

    Raises UsageError if no viewer answers, or its cursor is on a timeline without stamps.
    """
    import numpy as np

    if not isinstance(at, str):
        return at
    from rerun.experimental import ViewerClient

    try:
        socket.create_connection(("127.0.0.1", port), timeout=1).close()
        state = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy").get_state()
    except (OSError, RuntimeError, ValueError) as error:
        raise UsageError(f"--at {CURSOR}: no viewer answers on port {port} of this machine; {OPEN}") from error
    shown = next((each for each in state.recordings if each.store_id == state.active_recording), None)
    if shown is None or shown.current_time is None:
        raise UsageError(f"--at {CURSOR}: the viewer shows no recording; {OPEN}")
    kinds = {timeline.name: timeline.time_type for timeline in shown.timelines}
    if kinds.get(shown.current_timeline or "") != "timestamp":
        raise UsageError(
            f"--at {CURSOR}: the viewer's cursor is on the timeline '{shown.current_timeline}', which has no stamps; "
            "choose 'log clock' in its time panel"
        )
    return np.datetime64(shown.current_time, "ns")
