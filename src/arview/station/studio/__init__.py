"""The guide-view studio: a local page on which a part is set up, assessed and tried."""
