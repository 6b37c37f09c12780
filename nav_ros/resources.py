"""Where what comes with the package is: bundled bags, parameter files, executables.

A checkout (or an editable install of one) has them beside the packages, an installation in its
``share/attitude_alignment`` folder: the virtual environment's, or colcon's by way of the ament index.
"""

import sys
import sysconfig
from importlib import resources
from pathlib import Path

PACKAGE = "attitude_alignment"


def share_folder():
    """Return the folder that holds ``bags`` and ``config``.

    Raises
    ------
    FileNotFoundError
        Naming every folder that was searched.
    """
    folders = _candidate_folders()
    for folder in folders:
        if (folder / "package.xml").is_file() and (folder / "bags").is_dir():
            return folder
    raise FileNotFoundError(f"the files of {PACKAGE} are in none of {', '.join(map(str, folders))}")


def bundled_bag(name):
    """Return the folder of the bundled bag ``name``.

    Raises
    ------
    ValueError
        When there is no such bag; names those there are.
    """
    return _bundled("bags", name, "bag")


def bundled_config(name):
    """Return the parameter file ``name``, e.g. ``attitude.yaml``.

    Raises
    ------
    ValueError
        When there is no such file; names those there are.
    """
    return _bundled("config", name, "parameter file")


def executable(name):
    """Return the path of one of the package's executables, for starting it as a process.

    Raises
    ------
    FileNotFoundError
        Naming every folder that was searched.
    """
    # A virtual environment has them beside its Python, colcon in lib beside share.
    folders = [Path(sys.executable).parent, *(folder.parents[1] / "lib" / PACKAGE
                                              for folder in _candidate_folders()[1:])]
    for folder in folders:
        if (folder / name).is_file():
            return folder / name
    raise FileNotFoundError(f"{name} is in none of {', '.join(map(str, folders))}: is {PACKAGE} installed?")


def _bundled(folder_name, name, kind):
    folder = share_folder() / folder_name
    names = sorted(path.name for path in folder.iterdir() if not path.name.startswith("."))
    if name not in names:
        raise ValueError(f"no bundled {kind} {name!r}: there are {', '.join(names) or 'none'}")
    return folder / name


def _candidate_folders():
    checkout = Path(str(resources.files("nav_ros"))).parent
    folders = [checkout, Path(sysconfig.get_path("data")) / "share" / PACKAGE]
    try:
        from ament_index_python.packages import get_package_share_directory
        folders.append(Path(get_package_share_directory(PACKAGE)))
    except (ImportError, LookupError, OSError):  # no ament, not in its index, no AMENT_PREFIX_PATH
        pass
    return folders
