"""``python -m terrasim`` is the command ``terrasim``."""

from terrasim.cli import main

main()
