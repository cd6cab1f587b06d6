"""Scripts in processes of their own, with virtual devices, alone or together."""

import os
import socket
import subprocess
import sys


def start(script, *arguments, devices=1):
    environment = os.environ | {
        "XLA_FLAGS": f"--xla_force_host_platform_device_count={devices}",
        "JAX_PLATFORMS": "cpu",
    }
    command = [sys.executable, "-c", script, *map(str, arguments)]
    return subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)


def finish(*processes):
    """Waits for them; fails with what one that failed has said."""
    try:
        for process in processes:
            _, errors = process.communicate(timeout=300)
            assert process.returncode == 0, f"exit {process.returncode}: {errors[-2000:]}"
    finally:  # one that failed leaves the others waiting
        for process in processes:
            process.kill()
            process.communicate()


def together(script, *arguments, processes=2):
    """The same script in several processes, told coordinator, how many and which one it is."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        address = f"localhost:{free.getsockname()[1]}"
    finish(*(start(script, *arguments, address, processes, n) for n in range(processes)))
