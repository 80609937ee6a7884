"""Where a store may lie: on a disk of this machine."""

from __future__ import annotations

from pathlib import Path

from terrasim.errors import RunError

_REMOTE = frozenset(
    ["nfs", "nfs4", "cifs", "smb3", "smbfs", "afs", "ceph", "glusterfs", "lustre", "gfs2", "ocfs2"]
)
_REMOTE_FUSE = ("fuse.sshfs", "fuse.gluster", "fuse.s3fs", "fuse.gcsfuse", "fuse.rclone")
_MOUNTS = Path("/proc/self/mountinfo")


def require_local(path: Path) -> None:
    """Refuse a store on a network file system, where its log and its locks do not hold.

    Where the system does not tell, nothing is refused.

    Raises:
        RunError: If it lies on one.
    """
    try:
        mounts = _MOUNTS.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return
    kind = _kind(path.resolve(), mounts)
    if kind in _REMOTE or kind.startswith(_REMOTE_FUSE):
        raise RunError(
            f"{path} lies on a network file system ({kind}), where a store cannot be written "
            "safely; copy it to a disk of this machine"
        )


def _kind(path: Path, mounts: str) -> str:
    """Type of the file system that a path lies on; see proc(5)."""
    longest, kind = -1, ""
    for line in mounts.splitlines():
        before, _, after = line.partition(" - ")
        point = Path(before.split()[4].encode().decode("unicode_escape"))
        # A later mount at the same place hides the earlier one.
        if len(point.parts) >= longest and path.is_relative_to(point):
            longest, kind = len(point.parts), after.split()[0]
    return kind
