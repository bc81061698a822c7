"""A running `kinefit app`."""

import os
import re
import subprocess
import sys
from contextlib import contextmanager

TOKEN = "a-token-for-the-tests"


@contextmanager
def running_app(folder):
    """Start `kinefit app` in a folder; gives the process and its address with the token."""
    command = [sys.executable, "-m", "kinefit", "app", str(folder), "--port", "0", "--token", TOKEN, "--no-browser"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=os.environ)
    try:
        line = process.stdout.readline()
        found = re.search(r"http://\S+/", line)
        assert found, line + process.stdout.read()
        yield process, found[0].rstrip("/")
    finally:
        process.kill()
        process.communicate()
