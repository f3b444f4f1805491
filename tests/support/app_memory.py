"""What the worker of `sdps app` holds after each of many jobs: python tests/support/app_memory.py [jobs].

Jobs are the checks of 12 small photographs, a classical inference on them, and a scene of the studio, in turn.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
import photo_folders as folders
from app_server import Client, application
from sdps_scenes import hemisphere_lights


def main(count: int) -> None:
    """Print the worker's memory after every fifth job, in MiB."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        images, mask = folders.matte(hemisphere_lights(12, np.random.default_rng(0)), size=40)
        folders.write_folder(folder / "photographs", images, mask, bits=8)
        with application(folder) as (address, app):
            client = Client(address)
            path = client.new_set(folder / "photographs")
            for number in range(1, count + 1):
                if number % 3 == 0:
                    scene = {"shape": f"blobby:{number}", "material": "red-phenolic", "size": 128}
                    job = client.post("/studio/start/scene", scene)
                elif number % 3 == 1:
                    job = client.post(f"{path}/start/check")
                else:
                    path = client.new_set(folder / "photographs") if number % 30 == 2 else path
                    job = client.post(f"{path}/start/infer", {"method": "factorisation"})
                ended = client.wait(job, 600)
                assert ended["state"] == "done", ended
                if number % 5 == 0:
                    sys.stdout.write(f"{number:4d} jobs: {app.state.jobs.worker_memory / 2**20:.0f} MiB\n")
                    sys.stdout.flush()


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 50)
