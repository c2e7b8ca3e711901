"""What every room stands on: arrays, files, names, profiles, records, tables; and the one log of both packages."""

import logging

log = logging.getLogger("f3amd")
