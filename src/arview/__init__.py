"""arview: AR inspection of assemblies from CAD.

Guide views rendered from a CAD model drive detection and 6-DoF tracking of the part in monocular video;
the overlay draws the CAD ghost of every component with its measured deviation.
"""

__version__ = "0.1.0"
