"""Public data sets: download their captures, and import those that have a layout of their own."""
