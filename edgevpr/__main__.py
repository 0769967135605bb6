from edgevpr.cli.main import main

raise SystemExit(main())
