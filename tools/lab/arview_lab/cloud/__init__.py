"""Registration by ICP, and fits of simple shapes, with which the registration to the exact surface is compared."""
