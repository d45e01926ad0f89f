"""How much an installation takes on disk, by distribution: python benchmarks/install_size.py

Run it with the Python of the environment that is to be measured; compiled modules count.
"""

from importlib.metadata import distributions
from pathlib import Path


def sizes() -> dict[str, int]:
    """Return the bytes of each installed distribution."""
    found: dict[str, int] = {}
    for distribution in distributions():
        name = distribution.metadata["Name"].lower()
        paths = {Path(str(file.locate())) for file in distribution.files or ()}
        found[name] = sum(
            path.lstat().st_size for path in paths if path.is_file() and not path.is_symlink()
        )
    return found


def main() -> None:
    """Print the table."""
    found = sorted(sizes().items(), key=lambda item: -item[1])
    for name, size in found[:16]:
        print(f"{size / 1e6:8.0f} MB  {name}")
    rest = sum(size for _, size in found[16:])
    print(f"{rest / 1e6:8.0f} MB  {len(found[16:])} others")
    print(f"{sum(size for _, size in found) / 1e6:8.0f} MB  in all")


if __name__ == "__main__":
    main()
