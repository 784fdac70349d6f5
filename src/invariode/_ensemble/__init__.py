"""Many solves of one problem: the task, its rows on this machine, its parts elsewhere, results and stores."""
