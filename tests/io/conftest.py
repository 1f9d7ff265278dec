"""What every message about a file must be."""

import re

import pytest


@pytest.fixture
def check_message():
    """One sentence on one line that names all the given parts."""

    def check(error, parts):
        message = str(error.value)
        for part in parts:
            assert part in message
        assert "\n" not in message
        assert len(message) < 900  # some list all known names
        assert message.endswith(".")
        assert not re.search(r"[.!?] [A-Z]", message)
        assert "Traceback" not in message

    return check
