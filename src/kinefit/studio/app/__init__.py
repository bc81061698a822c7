"""`kinefit app`: a page in the browser over the same functions as the commands, for one user of this computer.

Everything that it makes is a file that the commands make too: take files, results, check pages. Long work is done by
the commands themselves in processes of their own (`jobs`), so that the page answers while they compute and the work of
a page that is closed, or of a server that is killed, goes on from its last checkpoint.
"""
