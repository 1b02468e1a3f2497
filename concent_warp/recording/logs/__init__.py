"""Logs of others as recordings: data sets, bags and folders of images, with a map of names, units and signs."""
