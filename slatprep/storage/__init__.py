"""Storage on local disks and object stores, where a result replaces an older one in one step."""
