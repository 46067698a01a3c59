"""``voronerf``, as torchrun starts each rank of an attack: the environment's HARM says what is wrong with one of them.

HARM is JSON: ``patience``, the seconds that ranks wait for each other; ``rank``, the one that is harmed; its
``file_size``, the bytes that a file of it may have, as on a full disk; and ``also``, options that it alone is given.
"""

from __future__ import annotations

import json
import os
import resource
import sys

from voronerf.cli import main
from voronerf.distributed import group

harm = json.loads(os.environ["HARM"])
group.PATIENCE = harm["patience"]
own = harm if os.environ["RANK"] == str(harm.get("rank")) else {}
if "file_size" in own:
    resource.setrlimit(resource.RLIMIT_FSIZE, (own["file_size"], own["file_size"]))
sys.exit(main([*sys.argv[1:], *own.get("also", [])]))
