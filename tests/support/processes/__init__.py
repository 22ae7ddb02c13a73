"""The `kantor` command and fleets of real processes: started, waited for, read and attacked. Start with `command.py`."""
