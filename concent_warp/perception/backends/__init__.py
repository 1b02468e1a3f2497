"""What follows objects in images: masks and point tracks, each behind a protocol, with and without learnt weights."""
