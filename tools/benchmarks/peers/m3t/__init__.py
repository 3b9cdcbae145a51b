"""The region tracker M3T, built from a checkout that the user gives."""
