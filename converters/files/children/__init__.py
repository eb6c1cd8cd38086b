"""Child processes that read or run untrusted files: started, confined, bounded, and asked over frames of bytes."""
