"""The whole line: photos and a video of one part → verdict, report and film; and many parts at once."""
