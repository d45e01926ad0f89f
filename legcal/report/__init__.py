"""What people and controllers read: accuracy, tables, calibrated files."""
