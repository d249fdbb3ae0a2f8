"""Run folders of plain files."""
