"""The whole workflow: from photos and a video of one part to verdict, report and film; and many parts at once."""
