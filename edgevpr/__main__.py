from edgevpr.cli.main import program

program()
