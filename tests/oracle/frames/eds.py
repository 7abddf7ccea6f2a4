"""The objects of EDS and DCF files, as the package canopen reads them.

    cd gateway/tests/eds
    python ../../../tests/oracle/frames/eds.py 5 drive.eds drive.dcf encoder.eds > objects.txt

Made with canopen 2.4.1, for node 5. One line per integer: the file, index and sub-index, the value,
and whether it is a ParameterValue. Ends with status 3 if canopen is not installed.
"""
import io
import pathlib
import sys

try:
    import canopen
    from canopen.objectdictionary import ODVariable, import_od
except ImportError as missing:
    print(missing, file=sys.stderr)
    sys.exit(3)

# Boolean, and integers of up to 32 bits.
KINDS = {1, 2, 3, 4, 5, 6, 7, 0x10, 0x16}
node = int(sys.argv[1])
for name in sys.argv[2:]:
    # It reads files in the system's encoding alone, and tells the format by the name.
    text = io.StringIO(pathlib.Path(name).read_bytes().decode("latin-1").replace("\r\n", "\n"))
    text.name = name
    objects = import_od(text, node)
    for index in sorted(objects):
        top = objects[index]
        variables = [top] if isinstance(top, ODVariable) else [top[sub] for sub in sorted(top)]
        for variable in variables:
            if variable.data_type not in KINDS:
                continue
            own = variable.value is not None
            value = variable.value if own else variable.default
            if value is not None:
                place = f"{variable.index:04X} {variable.subindex}"
                print(name, place, value, "own" if own else "default")
