"""Where components stand, measured in the photos themselves: by their surfaces and by their edges."""
