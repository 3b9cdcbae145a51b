"""The station: the live page, the studio, guided capture and the measurement while photos arrive."""
