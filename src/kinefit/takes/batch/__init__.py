"""Track takes into folders of results: one, many on one machine or a cluster; and summarise a study."""
