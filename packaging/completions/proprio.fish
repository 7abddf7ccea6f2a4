# Completions of fish: always those of the program that is installed.
proprio completions fish | source
