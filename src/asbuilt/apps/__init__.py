"""What a user may never meet: each folder is an app, and can be taken away.

The core imports no app; it finds commands, formats, estimators and report sections of the apps
that are installed by the names of their modules (`asbuilt.registry.find_app_modules`). An app
imports public names of `asbuilt` and of its stages, and no other app unless a line of its docstring
says `Uses: NAME.`
"""
