"""Where bytes lie: local disks and object stores, and how a result takes its place in one step."""
