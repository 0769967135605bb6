from edgevpr.cli import main

raise SystemExit(main())
