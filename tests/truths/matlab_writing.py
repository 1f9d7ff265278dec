"""MATLAB files of records that tests made."""

import numpy as np
import scipy.io


def write_matlab(path, recordings):
    """Cells of structs with rate, names and units of the channels, and a column a channel."""
    cells = np.empty(len(recordings), dtype=object)
    cells[:] = [
        {
            "sampling_rate_hz": one.sampling_rate,
            "start_time_s": one.start_time,
            "channels": np.array(one.channel_names, dtype=object),
            "quantity": np.array([channel.quantity for channel in one.channels], dtype=object),
            "unit": np.array([channel.si_unit for channel in one.channels], dtype=object),
            "point": np.array([channel.point for channel in one.channels], dtype=object),
            "direction": np.array([channel.direction for channel in one.channels], dtype=object),
            "values": one.values().T,
        }
        for one in recordings
    ]
    scipy.io.savemat(path, {"records": cells}, oned_as="column")
