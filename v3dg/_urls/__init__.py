"""Opens files at URLs that fsspec supports. The parts that are needed, or whole files,
are downloaded into a local file without a name.

`names` recognises and displays URLs. `addresses` decides which hosts may be contacted.
`http` sends requests to web servers and limits the cost of answers; `others` does the
same for other file systems. `failures` has the error texts, and `opened` manages the
local files.
"""

from v3dg._urls.names import beside as beside
from v3dg._urls.names import cleaned as cleaned
from v3dg._urls.names import folder_of as folder_of
from v3dg._urls.names import is_url as is_url
from v3dg._urls.names import shown as shown
from v3dg._urls.opened import FileAtUrl as FileAtUrl
from v3dg._urls.opened import in_parts as in_parts
from v3dg._urls.opened import reading as reading
